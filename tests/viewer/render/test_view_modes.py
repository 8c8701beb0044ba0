"""View modes: both engines draw the same, and each mode shows the property that it names."""

from __future__ import annotations

from dataclasses import replace

import moderngl
import numpy as np
import pytest
import torch

from progdf.demo_scenes import bear
from progdf.gaussians import Gaussians
from progdf.rasterize import activate
from tests.helpers.scenes import front_camera, random_gaussians
from tests.helpers.stacks import Stack, view_of
from viewer.camera.view_camera import first_camera
from viewer.render import dynamic_resolution
from viewer.render.engine import ViewEngine
from viewer.render.highlight import SELECTED, TINT, Highlight
from viewer.render.view_modes import RAMP_COLORS, apply, depth_range
from viewer.state.selection import pack
from viewer.state.view_state import VIEW_MODES, ViewState

SIZE = (160, 120)


@pytest.fixture
def cpu_engine(stack: Stack) -> ViewEngine:
    return ViewEngine(None, stack.scene, stack.gdfs, draw="cpu")


@pytest.mark.gl
@pytest.mark.parametrize("mode", VIEW_MODES)
def test_both_engines_draw_a_mode_alike(
    gl_engine: ViewEngine, cpu_engine: ViewEngine, stack: Stack, mode: str
) -> None:
    view = view_of(stack, 0.5, 0.5)
    images = [engine.image(view, SIZE, mode=mode) for engine in (gl_engine, cpu_engine)]
    error = np.square(images[0].astype(np.float64) - images[1]).mean()
    assert error < 1e-7  # 70 dB: back-to-front blending lacks the early stop, see `SplatRenderer`


@pytest.mark.gl
@pytest.mark.parametrize("mode", [mode for mode in VIEW_MODES if mode != "opacity"])
def test_both_engines_move_alike_in_a_mode(ctx: moderngl.Context, mode: str) -> None:
    scene = bear(6000).gaussians
    view = ViewState(camera=first_camera(scene), background=(1.0, 1.0, 1.0))
    images = []
    for draw in ("gl", "cpu"):
        engine = ViewEngine(ctx, scene, (), draw)
        engine.image(view, SIZE, pixels=2, mode=mode)
        dynamic_resolution._worker().submit(int).result()  # the pyramid is finished now
        images.append(engine.image(view, SIZE, pixels=2, mode=mode))
        whole = engine.image(view, SIZE, mode=mode)
        engine.release()
        assert not np.array_equal(images[-1], whole), "it has merged Gaussians"
    assert np.square(images[0].astype(np.float64) - images[1]).mean() < 1e-6


def test_view_mode_stays_out_of_pictures(cpu_engine: ViewEngine, stack: Stack) -> None:
    view = view_of(stack, 0.5, 0.5)
    plain = cpu_engine.image(view, SIZE)
    assert np.array_equal(cpu_engine.image(replace(view, mode="depth"), SIZE), plain)
    assert not np.array_equal(cpu_engine.image(view, SIZE, mode="depth"), plain)


def _three() -> Gaussians:
    """Return three Gaussians at different depths, all in the picture of `front_camera`."""
    means = torch.tensor([[0.0, 0.0, 3.0], [0.1, 0.0, 4.0], [0.0, 0.1, 5.0]])
    return replace(random_gaussians(3), means=means)


def colors(scene: Gaussians, mode: str) -> torch.Tensor:
    return apply(activate(scene), None, front_camera(), mode).colors


def test_opacity_ramp_starts_blue_and_ends_yellow() -> None:
    scene = replace(_three(), logit_opacities=torch.tensor([-80.0, 0.0, 80.0]))
    expected = torch.tensor([RAMP_COLORS[0], RAMP_COLORS[2], RAMP_COLORS[4]])
    torch.testing.assert_close(colors(scene, "opacity"), expected, atol=1e-5, rtol=0.0)


def test_near_gaussians_are_yellow_and_far_ones_blue() -> None:
    scene = _three()
    camera = front_camera()
    near, far = depth_range(scene.means, camera)
    depths = scene.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    order = depths.argsort()
    assert near < far
    drawn = colors(scene, "depth")[order]
    assert torch.equal(drawn[0], torch.tensor(RAMP_COLORS[4]))
    assert torch.equal(drawn[2], torch.tensor(RAMP_COLORS[0]))


def test_normal_of_a_disc_that_faces_the_camera_is_blue() -> None:
    thin = torch.tensor([0.0, 0.0, -5.0]).expand(3, 3)  # along the camera's axis
    scene = replace(_three(), log_scales=thin, quats=torch.eye(4)[:1].expand(3, 4))
    torch.testing.assert_close(colors(scene, "normals")[0], torch.tensor([0.5, 0.5, 1.0]))


def test_hidden_gaussians_have_no_center() -> None:
    gaussians = activate(_three())
    gaussians.opacities[1] = 0.0  # a highlight hides it so
    assert apply(gaussians, None, front_camera(), "centers").opacities.tolist() == [1.0, 0.0, 1.0]


def test_highlight_tints_a_mode() -> None:
    highlights = torch.tensor([[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    plain = colors(_three(), "normals")
    tinted = apply(activate(_three()), highlights, front_camera(), "normals").colors
    torch.testing.assert_close(tinted[0], 0.5 * plain[0] + torch.tensor([0.5, 0.0, 0.0]))
    assert torch.equal(tinted[1:], plain[1:])


@pytest.mark.gl
def test_window_tints_a_mode_alike_with_both_engines(
    ctx: moderngl.Context, gl_engine: ViewEngine, stack: Stack
) -> None:
    view = replace(view_of(stack, 0.5, 0.5), mode="normals")
    everything = pack(np.ones(len(stack.scene), bool))
    screen = ctx.simple_framebuffer(SIZE)
    shown = []
    shown_by_cpu = ViewEngine(ctx, stack.scene, stack.gdfs, draw="cpu")
    for engine in (gl_engine, shown_by_cpu):
        engine.highlight = Highlight(tinted=((everything, SELECTED, TINT),))
        engine.draw(view, screen, SIZE)
        shown.append(engine.renderer.pixels())
    shown_by_cpu.release()
    plain = gl_engine.image(view, SIZE, mode="normals")
    assert np.abs(shown[0] - plain).mean() > 0.02
    assert np.square(shown[0].astype(np.float64) - shown[1]).mean() < 1e-7
