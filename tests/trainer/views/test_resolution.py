"""How many views an edit gets and of how many pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from progdf.camera import Camera
from progdf.region import Region
from tests.helpers.demo_scenes import bear
from tests.helpers.trained import quick_options
from trainer.options import MOST_VIEWS, VIEWS, ViewOptions
from trainer.resolve import resolve
from trainer.setup import SAMPLING, SIZES, choose_resolution, make_training_setup
from trainer.views.view import region_rig


def choice(count: int, cameras: int | None = None, **said: object) -> tuple[int, int]:
    """Pixels and views for so many of the bear's Gaussians, with that many cameras given."""
    scene = bear(max(400, count)).gaussians[:count]
    region = Region("all", torch.arange(count), torch.ones(count))
    settings = ViewOptions(None if cameras is None else Path("c.json"))
    settings = replace(settings, **said)  # type: ignore[arg-type]

    def cameras_of(image_size: int, views: int) -> Sequence[Camera]:
        return region_rig(scene, region, cameras or views, image_size)

    found, views, _ = choose_resolution(settings, scene, region, cameras_of)
    return found[0].width, views


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the pixels, so that a small bear is dense."""
    monkeypatch.setattr("trainer.setup.SIZES", tuple(size // 10 for size in SIZES))


def test_a_sparse_region_gets_small_views() -> None:
    assert choice(60) == (25, MOST_VIEWS)


def test_a_dense_region_gets_larger_views() -> None:
    assert choice(6000) == (32, MOST_VIEWS)


def test_where_given_cameras_are_few_the_views_grow_further() -> None:
    assert choice(6000, cameras=12)[0] == 38


def test_what_was_typed_is_kept() -> None:
    assert choice(6000, views=7) == (38, 7)
    assert choice(6000, image_size=20) == (20, MOST_VIEWS)
    assert choice(6000, image_size=20, views=7) == (20, 7)


@pytest.mark.parametrize(("dense", "sampling"), [(True, SAMPLING), (False, 1.0)])
def test_an_edit_of_colors_is_meant_for_larger_pictures(dense: bool, sampling: float) -> None:
    scene = bear(400).gaussians
    region = Region("all", torch.arange(400), torch.ones(400))
    setup = make_training_setup(ViewOptions(views=5, dense=dense), scene, region)
    assert {view.camera.sampling for view in setup.views} == {sampling}


def test_what_is_painted_view_by_view_and_a_draft_stay_small() -> None:
    assert choice(6000, dense=False) == (25, VIEWS)
    plans = [
        resolve(quick_options(Path(), views=0, image_size=0, **more))
        for more in ({}, {"quick": True}, {"editor": "style:14"})
    ]
    assert [plan.views.dense for plan in plans] == [True, False, False]
