"""Parity of the fast writers of packed formats with their plain twins."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from progdf.formats.packed.compressed_ply import morton_order
from progdf.formats.scene_file import save_scene
from progdf.gaussians import Gaussians
from tests.helpers.scene_files import write_scene
from tests.helpers.scenes import random_gaussians


def plain_morton_order(means: Tensor) -> Tensor:
    """Return the rows in Z-order, one bit at a time. [N,3] -> [N]"""
    low = means.amin(dim=0)
    span = (means.amax(dim=0) - means.amin(dim=0)).clamp_min(1e-30)
    cells = ((means - low) / span * (2**21 - 1)).long()
    code = torch.zeros(len(means), dtype=torch.int64)
    for bit in range(21):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code.argsort(stable=True)


def hard_scene(degree: int) -> Gaussians:
    """Return a scene with values at and beyond the limits of an .spz."""
    scene = random_gaussians(2000, seed=8, sh_degree=degree)
    quats = scene.quats.clone()
    quats[:4] = torch.eye(4)
    quats[4:8] = -torch.eye(4)
    logits = scene.logit_opacities.clone()
    logits[:2] = torch.tensor([-30.0, 30.0])
    return replace(
        scene,
        quats=quats,
        logit_opacities=logits,
        sh0=4.0 * scene.sh0,
        shN=3.0 * scene.shN,
        log_scales=3.0 * scene.log_scales,
    )


@pytest.mark.parametrize("count", [1, 2, 5000])
def test_morton_order_equals_the_plain_loop_over_bits(count: int) -> None:
    means = random_gaussians(count, seed=4).means
    means = torch.cat([means, means[:1], 50.0 * means[-1:]])
    assert torch.equal(morton_order(means), plain_morton_order(means))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_has_the_values_of_the_library(degree: int, tmp_path: Path) -> None:
    scene = hard_scene(degree)
    save_scene(tmp_path / "ours.spz", scene)
    write_scene(tmp_path / "library.spz", scene, 3)
    contents = [gzip.decompress((tmp_path / f"{name}.spz").read_bytes()) for name in ("ours", "library")]
    ours, library = (np.frombuffer(content, np.uint8) for content in contents)
    np.testing.assert_array_equal(ours, library)
