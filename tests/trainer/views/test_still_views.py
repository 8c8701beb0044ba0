"""Views with fixed geometry: linear maps from colors to the same pictures."""

from __future__ import annotations

import torch

from progdf.gaussians import pack
from tests.helpers.trained import WHITE, small
from tests.trainer.views.test_tiles import COLORS, recolored
from trainer.views.crops import crop_scene, only_recolors, render_all


def test_still_view_without_gradients_matches_the_whole_box() -> None:
    case = small(count=2)
    rows = recolored(case.scene, case.region.members)
    assert only_recolors(rows - rows)
    for view in case.views:
        still, whole = (
            crop_scene(case.scene, case.region.members, view.camera, view.box, WHITE, still)
            for still in (True, False)
        )
        found, expected = (render_all([made], rows, COLORS)[0] for made in (still, whole))
        assert float((found - expected).abs().max()) < 2e-6, "sums in another order"
        assert (
            float((expected - view.image[view.box[1] : view.box[3], view.box[0] : view.box[2]]).abs().max())
            > 0.1
        )


def test_still_view_shows_the_original_where_no_member_is_visible() -> None:
    case = small(count=2)
    for view in case.views:
        box = (0, 0, view.camera.width, view.camera.height)
        still, whole = (
            crop_scene(case.scene, case.region.members, view.camera, box, WHITE, still)
            for still in (True, False)
        )
        assert still.live is not None
        assert torch.equal(still.original, whole.original)
        unedited = still.render(pack(case.scene[case.region.members]))
        assert float((unedited - whole.original.clamp(0, 1)).abs().max()) < 2e-6


def test_moved_members_are_not_only_recolored() -> None:
    offsets = torch.zeros(4, 5, 14)
    offsets[2, 3, 12] = 0.1
    assert only_recolors(offsets)
    offsets[2, 3, 6] = 1e-6
    assert not only_recolors(offsets)
