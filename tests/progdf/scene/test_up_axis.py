"""Tests of the up direction: option, cameras, ground, saved edit, and else the convention."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Tensor

from progdf.__main__ import main
from progdf.cli.options import parse_options
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import Gaussians
from progdf.gdf.file import save_gdf
from progdf.io.cameras import save_cameras
from progdf.io.picture_camera import camera_chunk
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.regions import parse_region
from progdf.scene.up_axis import AXES, axis_direction, direction_name, find_up, guess_up, up_from_json
from tests.helpers.demo_scenes import bear, room
from tests.helpers.scenes import ball, high_chair, random_gaussians, turned, upright_turn
from tests.helpers.stacks import bear_stack
from trainer.options import TrainingViewOptions
from trainer.views.setup import make_training_setup
from viewer.camera.view_camera import first_camera
from viewer.commands.open_stack import open_stack
from viewer.commands.options import RenderOptions
from viewer.files import session

MINUS_Y = [0.0, -1.0, 0.0]


def statue() -> Gaussians:
    """Return a tall object without a ground, whose flat sides face x. Nothing indicates its up direction."""
    scene = random_gaussians(4000, seed=3)
    place = torch.rand(4000, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    place[:, 0] = 0.5 * place[:, 0].sign()
    return replace(
        scene,
        means=place * torch.tensor([1.0, 3.0, 1.0]),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4000, 4).contiguous(),
        log_scales=torch.tensor([0.002, 0.03, 0.03]).log().expand(4000, 3).contiguous(),
        logit_opacities=torch.full((4000,), 2.0),
    )


def test_flat_sides_without_a_ground_are_no_floor() -> None:
    assert guess_up(statue()).tolist() == MINUS_Y


def test_flat_scene_is_no_ground() -> None:
    flat = statue()
    flat = replace(flat, means=flat.means * torch.tensor([0.001, 1.0, 1.0]))
    assert guess_up(flat).tolist() == MINUS_Y


@pytest.mark.parametrize("up", AXES)
def test_object_on_feet_is_upright_in_any_orientation(up: str) -> None:
    found = find_up(turned(high_chair(), upright_turn(axis_direction(up))))
    assert found.name == up
    assert "wider foot" in found.reason


def test_slanted_ground_gives_its_own_normal() -> None:
    slant = torch.nn.functional.normalize(torch.tensor([0.0, 0.94, 0.34]), dim=0)
    side = torch.tensor([1.0, 0.0, 0.0])
    demo = bear(3000).gaussians
    rotation = torch.stack([side, slant, torch.linalg.cross(side, slant)], dim=1)
    found = find_up(replace(demo, means=demo.means @ rotation.T))
    assert float(found.direction @ slant) > 0.998, "within 3.6 degrees"


def test_convention_alone_is_uncertain_and_lists_candidates() -> None:
    found = find_up(ball())
    assert found.direction.tolist() == MINUS_Y
    assert not found.certain
    assert "not certain" in found.reason
    assert len(found.candidates) >= 6


def test_cameras_beside_a_scene_determine_up_if_they_face_it(tmp_path: Path) -> None:
    (tmp_path / "point_cloud" / "iteration_7").mkdir(parents=True)
    path = tmp_path / "point_cloud" / "iteration_7" / "point_cloud.ply"
    level = orbit_rig(ball(), 6, 64, 64, up=torch.tensor([1.0, 0.0, 0.0]), elevations=(0.0, 0.0))
    save_cameras(tmp_path / "cameras.json", level)
    assert find_up(ball(), path=path).reason == "from the 6 cameras beside the scene's file"
    assert find_up(ball(), path=path).name == "+x"
    far = replace(ball(), means=ball().means + 1000.0)
    assert find_up(far, path=path).name == "-y", "cameras of another scene"
    save_cameras(tmp_path / "cameras.json", level, (1e6, 0.0, 0.0))
    assert find_up(ball(), path=path).name == "-y"
    assert find_up(replace(ball(), origin=(1e6, 0.0, 0.0)), path=path).name == "+x", "far from 0 in the file"


def test_training_from_a_picture_uses_the_up_axis_of_its_window(tmp_path: Path) -> None:
    scene = ball()
    camera = orbit_rig(scene, 1, 32, 32)[0]
    image = Image.new("RGB", (32, 32))
    image.save(tmp_path / "a.png", pnginfo=camera_chunk(camera, up=(0.0, 0.0, 1.0)))
    settings = TrainingViewOptions(pictures=(tmp_path / "a.png",))
    setup = make_training_setup(settings, scene, parse_region("all", scene))
    assert setup.up is not None
    assert setup.up.name == "+z"


@pytest.mark.parametrize("make", [bear, room])
def test_grounds_of_the_demo_scenes_override_the_convention(make: object) -> None:
    demo = make(3000)  # type: ignore[operator]
    found = find_up(demo.gaussians)
    assert torch.equal(found.direction, demo.up)
    assert "ground" in found.reason


def test_option_overrides_cameras_and_ground() -> None:
    demo = bear(3000)
    for axis in AXES:
        found = find_up(demo.gaussians, demo.cameras, axis)
        assert found.name == axis
        assert torch.equal(found.direction, axis_direction(axis))


def test_cameras_override_a_ground_and_are_level_within_two_degrees() -> None:
    scene = bear(3000).gaussians
    held = torch.nn.functional.normalize(torch.tensor([0.01, 0.0, -1.0]), dim=0)
    assert find_up(scene, orbit_rig(ball(), 12, 64, 64, up=held, elevations=(0.0, 0.0))).name == "-z"


def test_too_few_gaussians_use_the_convention() -> None:
    found = find_up(random_gaussians(3))
    assert found.direction.tolist() == MINUS_Y
    assert [direction_name(up) for up in found.candidates][:3] == ["-y", "+y", "+z"], "the usual ones first"


def test_saved_up_axis_is_restored_and_nonsense_is_ignored() -> None:
    up = find_up(bear(3000).gaussians)
    restored = up_from_json(up.to_json())
    assert restored is not None
    assert torch.equal(restored, up.direction)
    for nonsense in (
        None,
        3,
        {},
        {"direction": [0, 0, 0]},
        {"direction": [0, "y", 0]},
        {"direction": [1e99] * 3},
    ):
        assert up_from_json(nonsense) is None


def test_axis_option_may_start_with_a_minus() -> None:
    words = ["a.ply", "--up", "-z", "-o", "b.png"]
    assert parse_options(RenderOptions, words, "progdf render").drawing.up == "-z"


def test_info_prints_boxes_and_the_up_axis(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = random_gaussians(1000, seed=5)
    scene.means[0] = torch.tensor([70.0, 0.0, 0.0])
    save_ply(tmp_path / "a.ply", scene)
    level = orbit_rig(ball(), 6, 64, 64, up=torch.tensor([1.0, 0.0, 0.0]), elevations=(0.0, 0.0))
    save_cameras(tmp_path / "c.json", level)

    def said(*options: str) -> list[str]:
        assert main(["info", str(tmp_path / "a.ply"), *options]) == 0
        return capsys.readouterr().out.splitlines()

    lines = said()
    assert any(line.startswith("up: ") and "not certain" in line and "--up" in line for line in lines)
    read = load_ply(tmp_path / "a.ply")
    boxes = [line.partition("--region ")[2] for line in lines if "--region box:" in line]
    bulk, whole = (parse_region(box, read) for box in boxes)
    assert len(whole) == 1000
    assert 850 <= len(bulk) <= 999
    assert 0 not in bulk.members.tolist()
    assert "up: +z, set with --up" in said("--up", "+z")
    assert "up: +x, from the cameras" in said("--cameras", str(tmp_path / "c.json"))


def upright(tmp_path: Path, *arguments: str) -> tuple[float, ...]:
    options = parse_options(RenderOptions, [*arguments, "-o", str(tmp_path / "p.png")], "progdf render")
    found = open_stack(options.stack, options.drawing)
    return found.up if found.session is None else found.view.camera.up


def test_edit_stores_the_up_axis_of_its_scene(tmp_path: Path) -> None:
    stack = bear_stack(2000)
    scene, scarf, _ = stack.save(tmp_path)
    plus_y = (0.0, 1.0, 0.0)
    plus_x = (1.0, 0.0, 0.0)
    assert upright(tmp_path, str(scene)) == plus_y
    save_gdf(scarf, replace(stack.gdfs[0], report={"up": {"direction": [1.0, 0.0, 0.0], "reason": "told"}}))
    assert upright(tmp_path, str(scene), str(scarf)) == plus_x
    assert upright(tmp_path, str(scene), str(scarf), "--up", "+y") == plus_y


def test_session_keeps_the_up_axis_and_up_option_changes_it(tmp_path: Path) -> None:
    stack = bear_stack(2000)
    scene, _, _ = stack.save(tmp_path)
    options = parse_options(RenderOptions, [str(scene), "-o", "p.png"], "progdf render")
    found = open_stack(options.stack, options.drawing)
    view = replace(found.view, camera=first_camera(found.document.scene, up=(0.0, 0.0, 1.0)))
    session.save(tmp_path / "a.session.json", session.WindowSession(found.document, view))
    assert upright(tmp_path, str(tmp_path / "a.session.json")) == (0.0, 0.0, 1.0)
    assert upright(tmp_path, str(tmp_path / "a.session.json"), "--up", "-y") == (0.0, -1.0, 0.0)


def tilted(up: Tensor) -> str:
    return find_up(statue(), orbit_rig(ball(), 12, 64, 64, up=up, elevations=(0.0, 0.0))).name


def test_tilted_up_direction_is_named_by_its_components() -> None:
    for rounding in (0.0, 4e-17, -4e-8):
        assert tilted(torch.tensor([rounding, -0.957826, 0.287348])) == "0 -0.958 0.287"


@pytest.mark.parametrize("seed", range(4))
def test_cloud_without_a_direction_is_uncertain(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert not find_up(random_gaussians(300, seed=seed, scale=0.2)).certain
