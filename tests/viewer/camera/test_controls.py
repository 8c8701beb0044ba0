"""Camera controls stay valid for any input, moves can be reversed, and the key bindings are complete."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from progdf.camera import Camera, intrinsics, look_at
from tests.helpers.demo_scenes import bear
from tests.helpers.scenes import random_gaussians
from viewer.camera import controls
from viewer.camera.view_camera import (
    Bounds,
    Vec3,
    ViewCamera,
    add_scaled,
    axes,
    cross,
    dot,
    eye,
    first_camera,
    frame,
    to_camera,
    unit,
    with_up,
)
from viewer.state import workspace
from viewer.state.actions import perform
from viewer.state.facts import LayerRow
from viewer.state.view_state import LayerState, ViewState
from viewer.state.workspace import SceneFacts
from viewer.ui.keys import COMMANDS, FLY_KEYS, KEYS, TOOL_KEYS, drag_for

AXES: tuple[Vec3, ...] = ((0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0))
RADII = st.sampled_from([1e-3, 0.1, 1.0, 30.0, 1e4])
ANY = st.floats(allow_nan=True, allow_infinity=True)
PIXELS = st.floats(-500, 500)


@st.composite
def cameras(draw: st.DrawFn, radius: float | None = None) -> ViewCamera:
    """Draw any camera that the interface can produce, and slanted up axes from photographs."""
    size = draw(RADII) if radius is None else radius
    slanted = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 0.1)
    up = unit(draw(st.one_of(st.sampled_from(AXES), slanted)), (0.0, 1.0, 0.0))
    return ViewCamera(
        pivot=draw(st.tuples(*[st.floats(-3, 3).map(lambda c: c * size)] * 3)),
        distance=size * draw(st.floats(1e-3, 1e2)),
        azimuth=draw(st.floats(-180, 179.9)),
        elevation=draw(st.one_of(st.sampled_from([-90.0, 90.0, 0.0]), st.floats(-90, 90))),
        fov_y=draw(st.floats(10, 110)),
        up=up,
        mode=draw(st.sampled_from(["orbit", "fly"])),
    )


def near(a: Vec3, b: Vec3, size: float = 1.0) -> bool:
    return math.dist(a, b) <= 1e-9 * max(size, 1e-6)


def size_of(camera: ViewCamera) -> float:
    return camera.distance + math.hypot(*camera.pivot)


def usable(camera: ViewCamera) -> bool:
    """Return True if all values are finite, the rotation is proper and the distance is positive."""
    built = to_camera(camera, 640, 480)
    rotation = built.viewmat[:3, :3].double()
    numbers = (*camera.pivot, camera.distance, camera.azimuth, camera.elevation)
    return (
        all(math.isfinite(v) for v in numbers)
        and camera.distance > 0
        and bool(built.viewmat.isfinite().all())
        and bool(torch.allclose(rotation @ rotation.T, torch.eye(3).double(), atol=1e-5))
        and float(torch.linalg.det(rotation)) > 0.99
    )


@given(cameras(), ANY, ANY, ANY, st.sampled_from(["orbit", "look", "pan", "dolly"]), RADII)
@settings(max_examples=300, deadline=None)
def test_drag_keeps_the_camera_valid(
    camera: ViewCamera, dx: float, dy: float, height: float, does: str, radius: float
) -> None:
    assert usable(controls.drag(camera, does, dx, dy, height, radius))


@given(cameras(), ANY, st.tuples(*[st.sampled_from([-1.0, 0.0, 1.0])] * 3), ANY, RADII)
@settings(max_examples=200, deadline=None)
def test_wheel_and_flight_keep_the_camera_valid(
    camera: ViewCamera, steps: float, wish: Vec3, seconds: float, radius: float
) -> None:
    assert usable(controls.zoom(camera, steps, radius))
    assert usable(controls.fly(camera, *wish, seconds, radius, pace=10.0))


@given(cameras(), PIXELS, PIXELS)
def test_orbit_and_its_inverse_return_to_the_same_view(camera: ViewCamera, dx: float, dy: float) -> None:
    moved = controls.orbit(camera, dx, dy)
    assume(abs(moved.elevation) < 90.0)
    back = controls.orbit(moved, -dx, -dy)
    assert near(eye(back), eye(camera), size_of(camera))
    assert near(axes(back).right, axes(camera).right)


@given(cameras(), PIXELS, PIXELS)
def test_pan_and_its_inverse_return_to_the_same_view(camera: ViewCamera, dx: float, dy: float) -> None:
    back = controls.pan(controls.pan(camera, dx, dy, 600.0), -dx, -dy, 600.0)
    assert math.dist(back.pivot, camera.pivot) <= 1e-6 * size_of(camera) * max(1.0, abs(dx) + abs(dy))


@given(cameras(radius=1.0), st.floats(-10, 10))
def test_zoom_in_and_out_returns_to_the_same_distance(camera: ViewCamera, steps: float) -> None:
    back = controls.zoom(controls.zoom(camera, steps, 1.0), -steps, 1.0)
    assert back.distance == pytest.approx(camera.distance, rel=1e-9)


@given(cameras(), PIXELS, PIXELS)
def test_orbit_keeps_the_horizon_level(camera: ViewCamera, dx: float, dy: float) -> None:
    picture = axes(controls.orbit(camera, dx, dy))
    assert abs(dot(picture.right, camera.up)) < 1e-9
    assert dot(picture.up, camera.up) > -1e-9


@given(cameras(), PIXELS, PIXELS)
def test_orbiting_keeps_the_pivot_and_its_distance(camera: ViewCamera, dx: float, dy: float) -> None:
    moved = controls.orbit(camera, dx, dy)
    assert moved.pivot == camera.pivot
    assert math.dist(eye(moved), moved.pivot) == pytest.approx(camera.distance, rel=1e-6)


@given(cameras(), PIXELS, PIXELS)
def test_looking_around_keeps_the_eye_position(camera: ViewCamera, dx: float, dy: float) -> None:
    assert near(eye(controls.look(camera, dx, dy)), eye(camera), 10 * size_of(camera))


def test_dragging_right_moves_the_scene_to_the_right() -> None:
    camera = ViewCamera(elevation=0.0)
    left = add_scaled(camera.pivot, (-1.0, axes(camera).right), (1.0, axes(camera).back))
    before = to_camera(camera, 400, 400).viewmat @ torch.tensor([*left, 1.0])
    after = to_camera(controls.orbit(camera, 60, 0), 400, 400).viewmat @ torch.tensor([*left, 1.0])
    assert before[0] < after[0]


@given(cameras(), st.floats(-200, 200), st.floats(-200, 200))
@settings(deadline=None)
def test_panning_keeps_the_pivot_under_the_cursor(camera: ViewCamera, dx: float, dy: float) -> None:
    moved = to_camera(controls.pan(camera, dx, dy, 480.0), 640, 480)
    seen = moved.viewmat.double() @ torch.tensor([*camera.pivot, 1.0]).double()
    x, y = (moved.K[:2, :2].double() @ (seen[:2] / seen[2])).tolist()
    lost = 640 * 1e-5 * size_of(camera) / camera.distance  # float32 error of a far pivot seen from close by
    assert x == pytest.approx(dx, abs=0.01 + lost)
    assert y == pytest.approx(dy, abs=0.01 + lost)


@given(cameras(), st.sampled_from(AXES))
def test_changing_the_up_axis_keeps_eye_and_pivot(camera: ViewCamera, up: Vec3) -> None:
    turned = with_up(camera, up)
    assert turned.up == pytest.approx(up)
    assert turned.pivot == camera.pivot
    assert math.dist(eye(turned), eye(camera)) <= 1e-6 * size_of(camera)


@given(cameras(), st.tuples(*[st.floats(-2, 2)] * 3))
def test_double_click_looks_at_the_point_without_moving_the_eye(camera: ViewCamera, point: Vec3) -> None:
    away = math.dist(eye(camera), point)
    assume(1e-3 < away < 1e3)
    turned = controls.pivot_on(camera, point, 1.0)
    assert turned.pivot == point
    assert math.dist(eye(turned), eye(camera)) <= 1e-6 * (size_of(camera) + away)


def test_double_click_on_the_eye_position_keeps_the_camera_valid() -> None:
    camera = ViewCamera()
    assert usable(controls.pivot_on(camera, eye(camera), 1.0))


@given(cameras(), st.floats(1e-3, 1e4), st.floats(0.25, 4.0))
@settings(deadline=None)
def test_framing_shows_the_whole_sphere_in_any_window(
    camera: ViewCamera, radius: float, aspect: float
) -> None:
    framed = frame(camera, Bounds((1.0, 2.0, 3.0), radius), aspect)
    half = math.tan(math.radians(camera.fov_y) / 2) * min(1.0, aspect)
    assert radius / framed.distance < math.sin(math.atan(half))
    assert axes(framed) == axes(camera)


@pytest.mark.parametrize("elevation", [-90.0, 90.0])
def test_poles_are_ordinary_views(elevation: float) -> None:
    camera = ViewCamera(elevation=elevation, azimuth=33.0)
    picture = axes(camera)
    assert near(cross(picture.right, picture.up), picture.back)
    turned = controls.orbit(camera, 10, 0)
    assert dot(axes(turned).right, picture.right) == pytest.approx(math.cos(math.radians(3.0)))


def test_azimuth_0_is_the_front_view_for_every_up_axis() -> None:
    fronts = {(0, 1, 0): (0, 0, 1), (0, -1, 0): (0, 0, -1), (0, 0, 1): (0, -1, 0), (0, 0, -1): (0, 1, 0)}
    for up, expected in fronts.items():
        assert axes(ViewCamera(up=up, elevation=0.0)).back == pytest.approx(expected)


def test_flying_ahead_follows_the_view_at_the_scene_speed() -> None:
    camera = ViewCamera(distance=2.0)
    for radius in (1e-3, 1e4):
        flown = controls.fly(camera, 0, 0, 1, seconds=0.05, radius=radius)
        step = add_scaled(eye(flown), (-1.0, eye(camera)))
        assert dot(step, axes(camera).back) == pytest.approx(-0.05 * 0.6 * radius, rel=1e-6)


def test_stalled_frame_does_not_fly_far() -> None:
    camera = ViewCamera()
    assert controls.fly(camera, 0, 0, 1, 60.0, 1.0) == controls.fly(camera, 0, 0, 1, 0.1, 1.0)


def test_drags_match_the_table_of_mouse_bindings() -> None:
    assert drag_for("left", "", "orbit") == "orbit"
    assert drag_for("middle", "Shift", "orbit") == "pan"
    assert drag_for("middle", "Ctrl", "fly") == "dolly"
    assert drag_for("right", "", "orbit") == "pan"
    assert drag_for("right", "", "fly") == "look"
    assert drag_for("left", "Alt", "fly") == "orbit"
    assert drag_for("right", "Alt", "orbit") is None


def test_no_key_is_bound_twice_or_is_also_a_flight_key() -> None:
    assert len(KEYS) + len(TOOL_KEYS) == sum(len(command.keys.split()) for command in COMMANDS.values())
    assert not {*KEYS} & {*FLY_KEYS}


def test_every_command_has_an_action_with_and_without_layers() -> None:
    row = LayerRow(3, (0.5, 0.5, 0.5), (), "", Bounds())
    facts = SceneFacts("bear.ply", 3, Bounds(), (row,))
    for layers in ((), (LayerState(0, "scarf", 0.5),)):
        work = workspace.new_workspace(ViewState(layers=layers))
        for command in COMMANDS.values():
            after = perform(work, command.action, facts)
            assert usable(after.view.camera)
            assert all(0.0 <= layer.strength <= 1.0 for layer in after.view.layers)


def test_first_view_shows_the_whole_bear_with_and_without_cameras() -> None:
    demo = bear(1500)
    for cameras in (demo.cameras, ()):
        camera = first_camera(demo.gaussians, cameras, aspect=1.0)
        assert camera.up == (0.0, 1.0, 0.0), "the axis itself, not what photographs scatter around it"
        built = to_camera(camera, 400, 400)
        figure = demo.gaussians.means[demo.members("body", "head", "ears", "arms", "legs")]
        seen = figure @ built.viewmat[:3, :3].T + built.viewmat[:3, 3]
        pixels = seen[:, :2] / seen[:, 2:] * built.K[0, 0] + 200.0
        assert bool((seen[:, 2] > 0).all())
        assert bool(((pixels > 0) & (pixels < 400)).all())


def test_slanted_up_axis_is_kept() -> None:
    scene = random_gaussians(50)
    tilt = torch.tensor([math.sin(0.2), -math.cos(0.2), 0.0])
    level = look_at(torch.tensor([0.0, 0.0, -4.0]), torch.zeros(3), tilt)
    camera = Camera(level, intrinsics(0.9, 40, 24), 40, 24)
    assert first_camera(scene, [camera]).up == pytest.approx(tilt.tolist(), abs=1e-5)


def test_first_camera_of_an_empty_scene_is_valid() -> None:
    assert usable(first_camera(random_gaussians(0)))


def test_toggling_fly_does_not_move_the_picture() -> None:
    camera = ViewCamera()
    assert replace(controls.toggle_fly(camera), mode="orbit") == camera
    assert controls.toggle_fly(controls.toggle_fly(camera)) == camera
