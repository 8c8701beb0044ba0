"""View engine: minimal work between two states, consistent order, and equal pictures on every path."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import replace

import moderngl
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from progdf.compose.layer_paint import decode, encode
from progdf.compose.reference import Gains, Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.field.baked import BakedField
from progdf.field.grade import lattice_form
from progdf.gdf.file import apply_grade
from progdf.rasterize import render
from progdf.region import whole_scene
from tests.helpers.count import Count
from tests.helpers.edits import bits, edit_of
from tests.helpers.stacks import EARS, SCARF, Stack, view_of
from viewer.camera.view_camera import to_camera
from viewer.gl.present import read_rgb
from viewer.render import engine as engine_module
from viewer.render.dynamic_resolution import FrameTimings
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import is_software
from viewer.state.view_state import LayerState, ViewState

SIZE = (96, 72)
Compare = Callable[[str, np.ndarray], None]


@pytest.fixture(params=["gl", "cpu"])
def engine(request: pytest.FixtureRequest, ctx: moderngl.Context, stack: Stack) -> Iterator[ViewEngine]:
    view_engine = ViewEngine(ctx, stack.scene, stack.gdfs, request.param)
    yield view_engine
    view_engine.release()


@pytest.mark.gl
def test_picture_is_the_composed_scene(engine: ViewEngine, stack: Stack) -> None:
    view = view_of(stack, 0.7, 0.4)
    layers = [Layer(stack.gdfs[SCARF], 0.7), Layer(stack.gdfs[EARS], 0.4)]
    expected = render(compose_layers(stack.scene, layers), to_camera(view.camera, *SIZE)).image.numpy()
    image = engine.image(view, SIZE)
    assert image.shape == (72, 96, 3)
    assert image.dtype == np.float32
    assert float(np.abs(image - expected).max()) <= 0.0101, "more than the early stop at 1e-4 explains"


@pytest.mark.gl
@pytest.mark.parametrize("draw", ["gl", "cpu"])
def test_color_table_over_an_edit_is_drawn_as_composed(
    ctx: moderngl.Context, stack: Stack, draw: str
) -> None:
    table = torch.rand(125, 3, generator=torch.Generator().manual_seed(3))
    members = torch.zeros(0, dtype=torch.int64)
    field = BakedField("grade", torch.tensor([0.0, 1.0]), {}, 14, (), lattice_form(table))
    look = apply_grade(edit_of(stack.scene, members, field, "look"), stack.scene, whole_scene(stack.scene))
    engine = ViewEngine(ctx, stack.scene, (*stack.gdfs, look), draw)
    painted = encode(np.linspace(0.0, 1.0, len(look.region)))
    for strength, paint in ((0.4, ""), (1.0, painted), (1.2, ""), (0.0, "")):
        first = view_of(stack, 0.7, 0.4)
        top = LayerState(len(stack.gdfs), "look", strength, gains=Gains(color=0.75), paint=paint)
        view = replace(first, layers=(*first.layers, top), overshoot=True)
        layers = [Layer(stack.gdfs[SCARF], 0.7), Layer(stack.gdfs[EARS], 0.4)]
        layers.append(Layer(look, strength, gains=Gains(color=0.75), weights=decode(paint, len(look.region))))
        expected = compose_layers(stack.scene, layers, "adjust")
        assert bits(engine.gaussians(view)) == bits(expected)
        picture = render(expected, to_camera(view.camera, *SIZE)).image.numpy()
        assert float(np.abs(engine.image(view, SIZE) - picture).max()) <= 0.0101, "see above"
    engine.release()


@pytest.mark.gl
def test_strength_zero_is_the_original_bit_for_bit(engine: ViewEngine, stack: Stack) -> None:
    original = engine.image(replace(view_of(stack), layers=()), SIZE).copy()
    engine.image(view_of(stack, 0.8, 1.0), SIZE)
    assert np.array_equal(engine.image(view_of(stack), SIZE), original)


@pytest.mark.gl
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    path=st.lists(
        st.tuples(st.sampled_from([0.0, 0.2, 0.9, 1.0]), st.sampled_from([0.0, 0.5, 1.0])), max_size=4
    )
)
def test_picture_does_not_depend_on_earlier_states(
    gl_engine: ViewEngine, ctx: moderngl.Context, stack: Stack, path: list[tuple[float, float]]
) -> None:
    for scarf, ears in path:
        gl_engine.image(view_of(stack, scarf, ears), SIZE)
    there = gl_engine.image(view_of(stack, 0.3, 0.6), SIZE).copy()
    fresh = ViewEngine(ctx, stack.scene, stack.gdfs, draw="gl")
    assert np.array_equal(there, fresh.image(view_of(stack, 0.3, 0.6), SIZE))
    fresh.release()


@pytest.mark.gl
def test_both_renderers_give_the_same_picture(ctx: moderngl.Context, stack: Stack) -> None:
    by_gl, by_cpu = (ViewEngine(ctx, stack.scene, stack.gdfs, draw=draw) for draw in ("gl", "cpu"))
    for view in (view_of(stack, 1.0, 0.0), view_of(stack, 0.0, 0.5), view_of(stack, 0.2, 1.0)):
        difference = np.abs(by_gl.image(view, SIZE) - by_cpu.image(view, SIZE))
        assert float(difference.max()) <= 0.0101
        assert float((difference**2).mean()) <= 1e-7, "70 dB"
    by_gl.release()
    by_cpu.release()


@pytest.mark.gl
def test_unchanged_state_draws_nothing(
    engine: ViewEngine, stack: Stack, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = view_of(stack, 0.5)
    assert engine.needs_draw(view, SIZE)
    engine.image(view, SIZE)
    draws = Count(monkeypatch, engine.renderer, "draw")
    assert not engine.needs_draw(view, SIZE)
    assert not engine.needs_draw(replace(view, axes=False, panel=False), SIZE)
    engine.image(replace(view, axes=False), SIZE)
    assert draws.calls == 0


@pytest.mark.gl
def test_every_visible_change_needs_a_draw(engine: ViewEngine, stack: Stack) -> None:
    view = view_of(stack, 0.5, 0.5)
    engine.image(view, SIZE)
    turned = replace(view, camera=replace(view.camera, azimuth=3.0))
    weaker = replace(view.layers[0], gains=Gains(color=0.5))
    assert engine.needs_draw(turned, SIZE)
    assert engine.needs_draw(view, (97, 72))
    assert engine.needs_draw(view_of(stack, 0.5, 0.501), SIZE)
    assert engine.needs_draw(replace(view, blend="sum"), SIZE)
    assert engine.needs_draw(replace(view, background=(0.0, 0.0, 0.0)), SIZE)
    assert engine.needs_draw(replace(view, layers=(weaker, view.layers[1])), SIZE)
    assert engine.needs_draw(replace(view, layers=(replace(view.layers[0], enabled=False),)), SIZE)


@pytest.mark.gl
def test_hidden_or_zero_layer_causes_no_work(engine: ViewEngine, stack: Stack) -> None:
    engine.image(view_of(stack, 0.5, 0.0), SIZE)
    view = view_of(stack, 0.5, 0.0)
    assert not engine.needs_draw(replace(view, layers=(view.layers[0],)), SIZE)
    assert not engine.needs_draw(
        replace(view, layers=(view.layers[0], replace(view.layers[1], name="x"))), SIZE
    )


@pytest.mark.gl
def test_camera_move_composes_nothing(
    engine: ViewEngine, stack: Stack, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = view_of(stack, 0.5)
    engine.image(view, SIZE)
    composed = Count(monkeypatch, engine.composer, "update")
    uploaded = Count(monkeypatch, engine.renderer, "update")
    engine.image(replace(view, camera=replace(view.camera, azimuth=50.0)), SIZE)
    assert (composed.calls, uploaded.calls) == (0, 0)
    assert engine.timings.compose_ms == engine.timings.upload_ms == 0.0
    assert engine.timings.changed == 0


@pytest.mark.gl
def test_color_change_skips_sorting_and_position_change_sorts(
    gl_engine: ViewEngine, stack: Stack, monkeypatch: pytest.MonkeyPatch
) -> None:
    gl_engine.image(view_of(stack), SIZE)
    sorts = Count(monkeypatch, engine_module, "back_to_front")
    gl_engine.image(view_of(stack, scarf=0.6), SIZE)
    assert sorts.calls == 0
    gl_engine.image(view_of(stack, scarf=0.6, ears=0.6), SIZE)
    assert sorts.calls == 1


@pytest.mark.gl
def test_order_matches_the_positions_in_every_picture(gl_engine: ViewEngine, stack: Stack) -> None:
    """The order on the GPU matches the means on the GPU in every frame of a drag."""
    for ears in (0.0, 0.3, 0.7, 1.0):
        view = view_of(stack, ears=ears)
        gl_engine.image(view, SIZE)
        means = compose_layers(stack.scene, [Layer(stack.gdfs[EARS], ears)]).means.numpy()
        order = engine_module.back_to_front(means, to_camera(view.camera, *SIZE))
        assert np.array_equal(gl_engine.order, order)


@pytest.mark.gl
def test_only_members_of_the_moved_layer_are_composed(engine: ViewEngine, stack: Stack) -> None:
    engine.image(view_of(stack, 0.2, 0.5), SIZE)
    engine.image(view_of(stack, 0.3, 0.5), SIZE)
    assert engine.timings.changed == len(stack.gdfs[SCARF].region)


@pytest.mark.gl
def test_invalid_state_keeps_the_last_picture(engine: ViewEngine, stack: Stack) -> None:
    good = engine.image(view_of(stack, 0.4, 0.4), SIZE).copy()
    for broken in (
        replace(view_of(stack), layers=(LayerState(7, "gone", 0.5),)),
        view_of(stack, float("nan")),
        replace(view_of(stack, 1.0), blend="multiply"),
    ):
        with pytest.raises(ProgdfError):
            engine.image(broken, SIZE)
        assert not engine.needs_draw(view_of(stack, 0.4, 0.4), SIZE)
        assert np.array_equal(engine.image(view_of(stack, 0.4, 0.4), SIZE), good)


@pytest.mark.gl
def test_window_shows_the_picture_upright_in_its_lower_left_corner(
    engine: ViewEngine, ctx: moderngl.Context, stack: Stack
) -> None:
    screen = ctx.framebuffer([ctx.texture((120, 100), 4)])
    screen.clear(0.0, 1.0, 0.0)
    timings = engine.draw(view_of(stack, 1.0), screen, SIZE)
    shown = read_rgb(screen, (120, 100))
    image = np.round(np.clip(engine.image(view_of(stack, 1.0), SIZE), 0.0, 1.0) * 255.0)
    assert np.abs(shown[-72:, :96].astype(int) - image).max() <= 1
    assert (shown[:28] == (0, 255, 0)).all()
    assert (shown[:, 96:] == (0, 255, 0)).all()
    assert timings.total_ms >= timings.draw_ms > 0.0
    screen.release()


def test_engine_without_a_context_draws_on_the_cpu(stack: Stack) -> None:
    engine = ViewEngine(None, stack.scene, stack.gdfs)
    assert engine.draws_with == "cpu"
    assert engine.image(view_of(stack, 1.0), SIZE).shape == (72, 96, 3)
    with pytest.raises(ValueError, match="needs a context"):
        ViewEngine(None, stack.scene, draw="gl")


@pytest.mark.gl
def test_software_opengl_uses_the_cpu_rasterizer(ctx: moderngl.Context, stack: Stack) -> None:
    engine = ViewEngine(ctx, stack.scene, stack.gdfs)
    assert engine.draws_with == ("cpu" if is_software(ctx) else "gl")
    engine.release()


def test_edit_of_another_scene_is_refused(stack: Stack) -> None:
    with pytest.raises(ProgdfError, match="another scene"):
        ViewEngine(None, stack.scene[:100], stack.gdfs)


@pytest.mark.gl
def test_empty_scene_shows_the_background(engine: ViewEngine, ctx: moderngl.Context, stack: Stack) -> None:
    empty = ViewEngine(ctx, stack.scene[:0], draw=engine.draws_with)
    image = empty.image(ViewState(background=(0.2, 0.4, 0.6)), (8, 4))
    assert np.allclose(image, (0.2, 0.4, 0.6))
    empty.release()


@pytest.mark.gl
def test_released_engines_leave_no_gl_error(ctx: moderngl.Context, stack: Stack) -> None:
    assert ctx.error in ("GL_NO_ERROR", "GL_INVALID_OPERATION"), "asking clears what other tests left"
    for draw in ("gl", "cpu", "gl"):
        engine = ViewEngine(ctx, stack.scene, stack.gdfs, draw=draw)
        engine.image(view_of(stack, 0.5, 0.5), SIZE)
        engine.image(view_of(stack, 0.5, 0.5), (SIZE[1], SIZE[0]))
        engine.release()
        assert ctx.error == "GL_NO_ERROR", draw


def test_timings_add_up() -> None:
    assert FrameTimings(1.0, 2.0, 3.0, 4.0).total_ms == 10.0


def test_early_stop_error_bound_matches_the_tolerances() -> None:
    """A change of the constants has to meet the tolerances above: 0.01 = 1e-4 / (1 - 0.99)."""
    conventions = importlib.import_module("progdf.rasterize.engines")
    assert pytest.approx(0.01) == conventions.TRANSMITTANCE_MIN / (1.0 - conventions.ALPHA_MAX)
