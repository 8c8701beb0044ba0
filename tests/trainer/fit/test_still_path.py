"""Tests of pictures along a path of colors against renders of its offsets."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from progdf.field.separable import fit_separable
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from tests.helpers.trained import WHITE, small
from trainer.fit.still_path import still_path
from trainer.views.crops import crop_scene, render_all


def with_bands(scene: Gaussians, bands: int) -> Gaussians:
    """Return the scene with random higher bands."""
    generator = torch.Generator().manual_seed(5)
    return replace(scene, shN=0.2 * torch.randn(len(scene), bands, 3, generator=generator))


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
@pytest.mark.parametrize("with_shN", [True, False])
def test_pictures_of_a_path_match_renders_of_its_offsets(bands: int, with_shN: bool) -> None:
    case = small(count=10)  # more views than a batch
    scene = with_bands(case.scene, bands)
    members = case.region.members
    crops = [crop_scene(scene, members, v.camera, v.box, WHITE, still=True) for v in case.views]
    rows = pack(scene[members], with_shN=with_shN)
    generator = torch.Generator().manual_seed(6)
    knots = torch.tensor([0.0, 0.3, 0.7, 1.0])
    offsets = torch.zeros(4, *rows.shape)
    # large enough for colors below black at some knots only
    offsets[1:, :, BASE_CHANNELS - 3 :] = torch.randn(
        offsets[1:, :, BASE_CHANNELS - 3 :].shape, generator=generator
    )
    ranks = {"sh0": 2, "shN": 2} if with_shN and bands else {"sh0": 2}
    field = fit_separable(knots, offsets, ranks)
    path = still_path(crops, rows, field)
    assert path is not None
    for s in (0.0, 0.1, 0.3, 0.65, 0.2, 1.0):
        for fast, plain in zip(path(s), render_all(crops, rows + field.offsets(s)), strict=True):
            torch.testing.assert_close(fast, plain, atol=5e-6, rtol=0)


def test_path_of_moving_members_has_no_short_way() -> None:
    case = small(count=1)
    members = case.region.members
    rows = pack(case.scene[members])
    offsets = torch.zeros(2, *rows.shape)
    offsets[1, :, 0] = 0.1
    field = fit_separable(torch.tensor([0.0, 1.0]), offsets, {"means": 0})
    crops = [crop_scene(case.scene, members, v.camera, v.box, WHITE) for v in case.views]
    assert still_path(crops, rows, field) is None
