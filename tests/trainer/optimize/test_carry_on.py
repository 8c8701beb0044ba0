"""Decision on the parts of a region that no picture shows: measured, judged from behind, reported."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import pack
from tests.helpers.trained import WHITE, small
from trainer.editors import make_editor
from trainer.optimize import carry_on as module
from trainer.optimize.carry_on import CarryDecision, CarryRequest, decide_carry_on, is_found, turn_camera
from trainer.optimize.color_solver import Solver, make_solver
from trainer.optimize.color_views import color_views
from trainer.optimize.ties import surface_ties
from trainer.options import CarryOn, EditorOptions, with_values
from trainer.resolve import BLANK, check_options
from trainer.views.crops import crop_scene
from trainer.views.setup import TrainingSetup
from trainer.views.view import crop


@cache
def setup() -> TrainingSetup:
    case = small("body", count=6, image_size=96)
    front = max(case.views, key=lambda view: float(view.mask.sum()))
    return TrainingSetup(case.scene, case.region, [front])


def picture(half: bool) -> Tensor:
    """Return the front recolored, or only every other block of it."""
    given = setup()
    (view,) = given.train
    whole = make_editor(EditorOptions("recolor:#3060d0"), given.scene, given.region, [view]).edit(view, 1.0)
    if not half:
        return whole
    rows, columns = torch.meshgrid(*(torch.arange(n) for n in whole.shape[:2]), indexing="ij")
    return torch.where(((rows // 12 + columns // 12) % 2 == 0)[..., None], whole, view.image)


def solver() -> Solver:
    given = setup()
    (view,) = given.train
    members = given.region.members
    original = pack(given.scene[members], with_shN=True)
    drawn = color_views([crop_scene(given.scene, members, view.camera, view.box, WHITE)], original)
    return make_solver(drawn, original, surface_ties(given.scene, members, [view.camera]))


def decide(choice: CarryOn, region: str, half: bool = False) -> CarryDecision:
    edited = picture(half)
    targets = [crop(edited, setup().train[0].box)]
    return decide_carry_on(CarryRequest(choice, region), setup(), solver(), targets, [edited])


def test_whole_recolor_of_a_named_region_is_carried_on() -> None:
    found = decide("auto", "labels:l.npy:0")
    assert found.carries
    assert found.explained > 0.9
    assert found.unseen > 0.2 * found.shown
    figures = found.figures()
    assert (figures["guessed"], figures["unchanged"], figures["offered"]) == (found.unseen, 0, False)
    assert "which is a guess (no speckle and no new colors from behind)" in found.line


def test_paint_that_no_color_map_explains_is_not_carried_on() -> None:
    found = decide("auto", "all", half=True)
    assert not found.carries
    assert found.explained < 0.5
    assert found.behind is None
    assert "is explained" in found.reason
    assert found.figures()["unchanged"] == found.unseen


def test_region_found_from_the_picture_is_offered_instead() -> None:
    found = decide("auto", "changed")
    assert not found.carries
    assert found.figures()["offered"]
    assert "--carry-on always can continue it" in found.line
    assert not decide("auto", "changed", half=True).figures()["offered"]


@pytest.mark.parametrize(("choice", "carries"), [("always", True), ("never", False)])
def test_choice_of_the_user_overrides_the_measure(choice: CarryOn, carries: bool) -> None:
    found = decide(choice, "all", half=carries)
    assert found.carries is carries
    assert found.reason == f"--carry-on {choice}"
    assert found.figures()["offered"] is not carries


def test_regions_found_from_pictures_are_recognized() -> None:
    assert all(map(is_found, ("changed", " changed:A.png", "changed|refine")))
    assert not any(map(is_found, ("all", "labels:l.npy:1", "masks:changed")))


def test_camera_turned_by_half_looks_back_at_the_pivot() -> None:
    camera = setup().train[0].camera
    center = setup().scene.means[setup().region.members].double().mean(dim=0)
    axis = -camera.viewmat[1, :3].double()
    behind = turn_camera(camera, center, axis, 180.0)
    before, after = (
        one.viewmat.double() @ torch.cat([center, torch.ones(1).double()]) for one in (camera, behind)
    )
    assert torch.allclose(before[2:], after[2:], atol=1e-5)
    assert torch.allclose(
        camera.viewmat[2, :3].double() @ axis, behind.viewmat[2, :3].double() @ axis, atol=1e-5
    )
    again = turn_camera(behind, center, axis, 180.0)
    assert torch.allclose(again.viewmat, camera.viewmat, atol=1e-5)


def test_new_colors_and_speckle_are_found() -> None:
    known = np.array([[0.1, 0.0], [-0.1, 0.0], [0.0, 0.1], [0.0, -0.1]])
    mixed = np.tile([0.04, 0.02], (30, 1))
    near = np.tile([0.12, 0.0], (20, 1))
    far = np.tile([-0.3, 0.0], (50, 1))
    found = module._share_of_new_colors(np.concatenate([mixed, near, far]), known, 0.1)
    assert found == pytest.approx(0.5)
    assert module._share_of_new_colors(far, np.zeros((4, 2)), 0.1) == 0.0, "grays have no hull"
    inside = torch.ones(40, 40, dtype=torch.bool)
    change = torch.zeros(40, 40, 3)
    change[10:30, 10:30] = 0.5
    assert module._speckle(change, inside) < 0.02
    change[::2, ::2] = 0.5 - change[::2, ::2]
    assert module._speckle(change, inside) > 0.2


def test_option_is_refused_for_other_editors() -> None:
    options = with_values(BLANK, editor="recolor:#3060d0", carry_on="always")
    with pytest.raises(ProgdfError, match="--carry-on does not apply to recolor; it is for pictures"):
        check_options(options)
