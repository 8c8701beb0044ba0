"""Parity of the fast writers of packed formats with their plain twins."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from progdf.formats.packed import sog_writer
from progdf.formats.packed.compressed_ply import morton_order
from progdf.formats.packed.palette_kernel import reassign, split_groups
from progdf.formats.scene_file import load_scene, save_scene
from progdf.gaussians import Gaussians
from tests.helpers.plain_palette import plain_reassign, plain_split_groups
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


def rows_of(count: int, columns: int = 9) -> np.ndarray:
    """Return rows around a few centers, some of them equal."""
    rng = np.random.default_rng(count)
    rows = rng.normal(size=(5, columns))[rng.integers(0, 5, count)] + 0.2 * rng.normal(size=(count, columns))
    rows[::7] = rows[0]
    return rows.astype(np.float32)


@pytest.mark.parametrize(("count", "groups"), [(1, 1), (2, 5), (300, 40), (300, 1000)])
def test_palette_groups_equal_those_of_the_plain_tree(count: int, groups: int) -> None:
    rows = rows_of(count)
    order, starts = split_groups(rows, groups)
    found = sorted(sorted(group.tolist()) for group in np.split(order, starts[1:-1]))
    assert found == sorted(plain_split_groups(rows, groups))
    assert len(found) <= groups


def test_reassigned_labels_equal_those_of_the_plain_search() -> None:
    rows = rows_of(300)
    centers = rows[::10].copy()
    labels = np.arange(300) // 10
    expected = plain_reassign(rows, centers, labels, 6)
    reassign(rows, centers, labels, 6)
    np.testing.assert_array_equal(labels, expected)


def test_full_palette_keeps_similar_rows_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sog_writer, "_MAX_PALETTE", 64)
    rows = rows_of(2000)
    centers, labels = sog_writer.make_palette(rows)
    assert len(centers) <= 64
    assert float(((centers[labels] - rows) ** 2).mean()) < 0.8 * 0.2**2
    np.testing.assert_allclose(centers[labels[0]], rows[0], atol=0.1)


@pytest.mark.parametrize("degree", [0, 3])
def test_sog_is_as_near_to_the_scene_as_that_of_the_library(degree: int, tmp_path: Path) -> None:
    scene = random_gaussians(3000, seed=6, sh_degree=degree)
    save_scene(tmp_path / "ours.sog", scene)
    write_scene(tmp_path / "library.sog", scene)
    ours, library = (load_scene(tmp_path / f"{name}.sog") for name in ("ours", "library"))
    for name in ("means", "log_scales", "sh0", "shN"):
        if not getattr(scene, name).numel():
            continue
        errors = []
        for found in (ours, library):
            columns = [
                getattr(each, name).reshape(len(scene), -1).sort(dim=0).values for each in (found, scene)
            ]
            errors.append(float((columns[0] - columns[1]).square().mean()))
        assert errors[0] <= 1.1 * errors[1] + 1e-9, name
