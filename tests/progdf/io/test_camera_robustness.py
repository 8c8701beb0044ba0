"""Tests of the viewing camera in pictures: any scene size, up axis and window, poles, and inside objects."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import moderngl
import numpy as np
import pytest
import torch

from progdf.gaussians import Gaussians
from progdf.metrics.image import psnr
from progdf.scene.subject import subject_rows
from tests.helpers.demo_scenes import bear, room
from tests.helpers.stacks import bear_stack
from tests.helpers.ui_rig import first_view, rig
from viewer.camera import controls
from viewer.camera.view_camera import (
    FILL,
    Bounds,
    Vec3,
    ViewCamera,
    axes,
    bounds_of,
    first_camera,
    frame,
    to_camera,
)
from viewer.files.document import Document
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import Image
from viewer.state import workspace
from viewer.state.actions import perform
from viewer.state.commands import Plain
from viewer.state.view_state import ViewState

pytestmark = pytest.mark.gl
SIZE = (64, 48)
DRAWS = pytest.mark.parametrize("draw", ["gl", "cpu"])
UP = torch.tensor([0.0, 1.0, 0.0])
BACKGROUND: Vec3 = (1.0, 1.0, 1.0)


@cache
def the_bear() -> Gaussians:
    """Return the bear without view dependence, which would have to rotate with the scene."""
    scene = bear(1500).gaussians
    return replace(scene, shN=scene.shN[:, :0])


def scaled(scene: Gaussians, factor: float) -> Gaussians:
    return replace(scene, means=scene.means * factor, log_scales=scene.log_scales + math.log(factor))


def about_x(scene: Gaussians, degrees: float) -> Gaussians:
    """Return the scene rotated about x."""
    half = math.radians(degrees) / 2
    c = math.cos(half)
    s = math.sin(half)
    w, x, y, z = scene.quats.unbind(1)
    turned = torch.stack([c * w - s * x, c * x + s * w, c * y - s * z, c * z + s * y], dim=1)
    cos = math.cos(2 * half)
    sin = math.sin(2 * half)
    x, y, z = scene.means.unbind(1)
    means = torch.stack([x, cos * y - sin * z, sin * y + cos * z], dim=1)
    return replace(scene, means=means, quats=turned)


def pictured(
    ctx: moderngl.Context,
    scene: Gaussians,
    draw: str,
    camera: ViewCamera | None = None,
    size: tuple[int, int] = SIZE,
) -> Image:
    engine = ViewEngine(ctx, scene, draw=draw)
    try:
        view = ViewState(camera=camera or first_camera(scene), background=BACKGROUND)
        return engine.image(view, size)
    finally:
        engine.release()


def agreement(a: Image, b: Image) -> float:
    return float(psnr(torch.from_numpy(a.copy()), torch.from_numpy(b.copy())))


@DRAWS
@pytest.mark.parametrize("factor", [1e-3, 1e-1, 1e4])
def test_scene_of_any_size_opens_with_the_same_picture(
    ctx: moderngl.Context, draw: str, factor: float
) -> None:
    scene = the_bear()
    assert agreement(pictured(ctx, scaled(scene, factor), draw), pictured(ctx, scene, draw)) > 45.0


@DRAWS
@pytest.mark.parametrize(("degrees", "up"), [(180.0, (0, -1, 0)), (90.0, (0, 0, 1)), (-90.0, (0, 0, -1))])
def test_scene_of_any_up_axis_opens_with_the_same_picture(
    ctx: moderngl.Context, draw: str, degrees: float, up: Vec3
) -> None:
    scene = the_bear()
    turned = about_x(the_bear(), degrees)
    assert first_camera(turned).up == up
    assert agreement(pictured(ctx, turned, draw), pictured(ctx, scene, draw)) > 45.0


@DRAWS
@pytest.mark.parametrize("factor", [1e-3, 1e4])
@pytest.mark.parametrize("elevation", [-90.0, 90.0])
def test_camera_at_the_poles_draws_without_a_jump(
    ctx: moderngl.Context, draw: str, factor: float, elevation: float
) -> None:
    scene = scaled(the_bear(), factor)
    camera = replace(first_camera(scene), elevation=elevation)
    image = pictured(ctx, scene, draw, camera)
    assert np.isfinite(image).all()
    assert (np.abs(image - 1.0).max(axis=-1) > 0.1).mean() > 0.1, "there is something to see"
    nearly = pictured(ctx, scene, draw, replace(camera, elevation=elevation * (1.0 - 1e-6)))
    assert agreement(image, nearly) > 40.0, "no jump at the pole"


@DRAWS
@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e4])
def test_closest_zoom_is_finite_and_can_be_undone(ctx: moderngl.Context, draw: str, factor: float) -> None:
    scene = scaled(the_bear(), factor)
    first = first_camera(scene)
    radius = bounds_of(scene).radius
    near = controls.zoom(first, 1e6, radius)
    assert 0.0 < near.distance < 1e-3 * radius
    assert np.isfinite(pictured(ctx, scene, draw, near)).all()
    moved = controls.orbit(controls.pan(near, 300.0, -200.0, 480.0), 500.0, 900.0)
    assert np.isfinite(pictured(ctx, scene, draw, moved)).all()
    back = controls.zoom(near, math.log(near.distance / first.distance) / controls.ZOOM_PER_STEP, radius)
    assert agreement(pictured(ctx, scene, draw, back), pictured(ctx, scene, draw)) > 45.0
    far = controls.zoom(first, -1e6, radius)
    assert np.isfinite(pictured(ctx, scene, draw, far)).all()


@DRAWS
def test_camera_on_its_own_pivot_still_draws(ctx: moderngl.Context, draw: str) -> None:
    image = pictured(ctx, the_bear(), draw, ViewCamera(distance=1e-12))
    assert np.isfinite(image).all()


@DRAWS
@pytest.mark.parametrize("size", [(40, 160), (160, 40), (1, 200), (200, 1), (1, 1)])
def test_framing_shows_the_whole_scene_in_any_window(
    ctx: moderngl.Context, draw: str, size: tuple[int, int]
) -> None:
    scene = the_bear()
    camera = frame(first_camera(scene), bounds_of(scene), size[0] / size[1])
    image = pictured(ctx, scene, draw, camera, size)
    assert image.shape == (size[1], size[0], 3)
    assert np.isfinite(image).all()
    seen = scene.means[(scene.means - torch.tensor(camera.pivot)).norm(dim=1) < bounds_of(scene).radius]
    built = to_camera(camera, *size)
    local = seen @ built.viewmat[:3, :3].T + built.viewmat[:3, 3]
    x, y = (local[:, :2] / local[:, 2:] @ built.K[:2, :2].T + built.K[:2, 2]).unbind(1)
    assert bool(((x >= 0) & (x <= size[0]) & (y >= 0) & (y <= size[1])).all())


def filled(camera: ViewCamera, shown: Gaussians, aspect: float) -> np.ndarray:
    """Return how far these Gaussians reach left, right, up and down without strays; 1 is the edge. [4]"""
    built = to_camera(camera, round(1200 * aspect), 1200)
    local = shown.means @ built.viewmat[:3, :3].T + built.viewmat[:3, 3]
    assert bool((local[:, 2] > 0).all())
    across = local[:, :2] / local[:, 2:] * built.K.diagonal()[:2] / built.K[:2, 2]
    low = across.quantile(0.005, dim=0)
    high = across.quantile(0.995, dim=0)
    return torch.stack([-low[0], high[0], -low[1], high[1]]).numpy()


def is_filled(camera: ViewCamera, shown: Gaussians, aspect: float) -> bool:
    """Return True if the Gaussians fill the tighter side of the picture and are centered."""
    left, right, up, down = filled(camera, shown, aspect)
    widest = max(left, right, up, down)  # of centers; Gaussians as large as these ears add a third
    return abs(left - right) < 0.07 and abs(up - down) < 0.07 and 0.45 < widest < FILL


@pytest.mark.parametrize("aspect", [0.25, 0.5, 1.0, 4.0])
@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e4])
def test_f_without_a_layer_frames_the_subject_in_any_window(aspect: float, factor: float) -> None:
    scene = scaled(the_bear(), factor)
    for azimuth, elevation in ((20.0, 15.0), (110.0, 40.0)):
        view = ViewState(camera=ViewCamera(azimuth=azimuth, elevation=elevation))
        work = perform(workspace.new_workspace(view), Plain("frame"), Document("x", scene).facts(), aspect)
        assert is_filled(work.view.camera, scene[subject_rows(scene, UP)], aspect)
        assert axes(work.view.camera) == axes(view.camera)


@pytest.mark.parametrize("aspect", [0.5, 1.5])
@pytest.mark.parametrize("layer", [0, 1])
def test_f_frames_the_members_of_the_focused_layer(aspect: float, layer: int) -> None:
    stack = bear_stack(1500)
    view = first_view(stack, 0.5, 0.5)
    work = replace(workspace.new_workspace(view), focus=layer)
    facts = Document("x", stack.scene, stack.gdfs).facts()
    camera = perform(work, Plain("frame"), facts, aspect).view.camera
    assert is_filled(camera, stack.scene[stack.gdfs[layer].region.members], aspect)
    assert axes(camera) == axes(view.camera)


def test_f_frames_a_room_from_outside_and_an_empty_scene_at_the_origin() -> None:
    scene = room(4000).gaussians
    inside = workspace.new_workspace(ViewState(camera=first_camera(scene)))
    outside = perform(inside, Plain("frame"), Document("x", scene).facts()).view.camera
    assert filled(outside, scene, 1.0).max() < 1.0
    nothing = perform(inside, Plain("frame"), Document("x", scene[:0]).facts()).view.camera
    assert nothing == frame(inside.view.camera, Bounds())


@pytest.mark.parametrize("points", [(400, 900), (1600, 400)])
def test_narrow_and_wide_windows_are_usable(points: tuple[int, int]) -> None:
    with rig(points=points) as user:
        before = user.main_view.work.view.camera
        user.drag((100.0, 200.0), (130.0, 220.0))
        assert user.main_view.work.view.camera != before
        user.key("F")
        user.key("T")
        assert np.isfinite(user.main_view.engine.image(user.main_view.work.view, (20, 80))).all()
