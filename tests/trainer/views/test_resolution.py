"""Number and resolution of the views of an edit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from progdf.io.cameras import save_cameras
from progdf.region import Region
from progdf.scene.bounds import scene_sphere
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.demo_scenes import bear
from tests.helpers.trained import quick_options, train, write_bear
from trainer.options import EditorOptions, TrainingViewOptions
from trainer.resolve import resolve
from trainer.run.training import pixel_stride
from trainer.views.setup import (
    SAMPLING,
    SIZE_LIMITS,
    TrainingSetup,
    make_training_setup,
    render_thumbnails,
)
from trainer.views.size import MAX_SIDE_PX


def setup_of(count: int = 400, bands: int = 3, **said: object) -> TrainingSetup:
    """Return the setup of a bear with these view options and `bands` SH functions beyond DC."""
    scene = bear(count).gaussians
    scene = replace(scene, shN=torch.zeros(count, bands, 3))
    region = Region("all", torch.arange(count), torch.ones(count))
    return make_training_setup(replace(TrainingViewOptions(), **said), scene, region)  # type: ignore[arg-type]


def test_color_edit_gets_more_views_and_given_values_are_kept() -> None:
    assert [len(setup_of(dense=dense).train) for dense in (True, False)] == [34, 24]
    assert [len(setup_of(bands=bands).train) for bands in (0, 8)] == [34, 42]
    assert len(setup_of(views=7).train) == 6
    assert setup_of(views=5, image_size=40).train[0].camera.width == 40


@pytest.mark.parametrize("dense", [True, False])
def test_rig_has_the_chosen_size_and_names_it_in_the_notes(dense: bool) -> None:
    setup = setup_of(views=5, dense=dense)
    side = setup.train[0].camera.width
    assert SIZE_LIMITS[dense].min_side <= side <= MAX_SIDE_PX
    assert any(note.startswith(f"views of {side} pixels") for note in setup.notes)


@pytest.mark.parametrize(("dense", "sampling"), [(True, SAMPLING), (False, 1.0)])
def test_color_edit_is_sampled_for_larger_pictures(dense: bool, sampling: float) -> None:
    setup = setup_of(views=5, dense=dense)
    assert {view.camera.sampling for view in setup.views} == {sampling}


@pytest.mark.parametrize(("dense", "lowest", "highest"), [(True, 0.0, 89.0), (False, 5.0, 60.0)])
def test_color_edit_is_viewed_from_level_to_above(dense: bool, lowest: float, highest: float) -> None:
    setup = setup_of(views=60, dense=dense, up="+y")
    center, _ = scene_sphere(setup.scene)
    back = torch.stack([view.camera.position - center for view in setup.views])
    rises = torch.nn.functional.normalize(back, dim=1)[:, 1].asin().rad2deg()
    assert lowest - 0.1 <= float(rises.min()) <= lowest + 2.0
    # even in area; the highest of 60 views is at 80°
    assert highest - 10.0 <= float(rises.max()) <= highest + 0.1


@pytest.mark.slow
@pytest.mark.parametrize("editor", ["recolor:#3060d0", "stripes:#20a040"])
def test_edited_picture_does_not_depend_on_the_other_views(tmp_path: Path, editor: str) -> None:
    write_bear(tmp_path)
    save_cameras(tmp_path / "cameras.json", [camera.resize(64, 48) for camera in bear(1500).cameras])
    made = []
    for count in (3, 8):
        given = {"cameras": tmp_path / "cameras.json", "views": count, "editor": editor}
        train(quick_options(tmp_path, f"of {count}", **given))
        edited = (tmp_path / f"of {count}" / "views" / "edited").glob("*.png")
        made.append({path.name: path.read_bytes() for path in edited})
    shared = made[0].keys() & made[1].keys()
    assert shared
    assert all(made[0][name] == made[1][name] for name in shared)


def test_region_is_viewed_by_cameras_that_show_it(tmp_path: Path) -> None:
    demo = bear(1500)
    region = Region("body", demo.members("body"), torch.ones(len(demo.members("body"))))
    away = [replace(c, viewmat=torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ c.viewmat) for c in demo.cameras]
    save_cameras(tmp_path / "cameras.json", [*away, *demo.cameras[:4], *away])
    seen = render_thumbnails(TrainingViewOptions(tmp_path / "cameras.json"), demo.gaussians, region)
    assert len(seen) == 4
    assert all(bool(one.mask.any()) for one in seen)
    assert len(render_thumbnails(TrainingViewOptions(), demo.gaussians, region)) == 8


@pytest.mark.parametrize("beside", ["", "views", "views/edited"])
def test_pictures_of_a_run_use_its_own_cameras(tmp_path: Path, beside: str) -> None:
    pictures = tmp_path / "views" / "edited"
    given = tmp_path / "others.json"
    pictures.mkdir(parents=True)
    options = quick_options(tmp_path, editor=f"folder:{pictures}")
    assert resolve(options).views.cameras is None
    path = tmp_path / beside / "cameras.json"
    path.write_text("[]", encoding="utf-8")  # from another program
    assert resolve(options).views.cameras is None
    save_cameras(path, orbit_rig(bear(400).gaussians, 3, 20, 20))
    assert resolve(options).views.cameras == path
    assert resolve(replace(options, editor=EditorOptions("recolor:#f00"))).views.cameras is None
    said = replace(options, views=replace(options.views, cameras=given))
    assert resolve(said).views.cameras == given


def test_dense_views_are_only_for_solved_color_edits() -> None:
    plans = [
        resolve(quick_options(Path(), views=0, image_size=0, **more))
        for more in ({}, {"quick": True}, {"editor": "style:14"}, {"color_solver": False})
    ]
    assert [plan.views.dense for plan in plans] == [True, False, False, False]


@pytest.mark.parametrize(
    ("members", "bands", "every"), [(4000, 0, 1), (2000, 0, 2), (500, 0, 4), (700, 3, 2)]
)
def test_fewer_pixels_are_solved_if_many_show_each_number(members: int, bands: int, every: int) -> None:
    setup = setup_of(members, bands, views=5, image_size=160)
    assert pixel_stride(setup) == every
    shown = sum(int((view.mask > 0.0).sum()) for view in setup.train) / members / (1 if bands == 0 else 3)
    assert every == 1 or shown / every >= 9.0
    assert every == 4 or shown / (2 * every) < 9.0
