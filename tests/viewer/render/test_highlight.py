"""Painted weights shown as colors: the color ramp, both renderers, and pictures without highlights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
import pytest
import torch

from progdf.compose import layer_paint
from progdf.gaussians import Gaussians
from progdf.sh import C0
from tests.helpers.stacks import Stack
from tests.helpers.ui_rig import HEAD, TRACK, Rig, bear, first_view, rig
from viewer.render import highlight
from viewer.render.engine import ViewEngine
from viewer.render.highlight import Highlight
from viewer.state import selection
from viewer.state.selection import SelectionState
from viewer.state.view_state import Brush, Comparison, LayerState, SelectTool, ViewState
from viewer.state.workspace import with_transient

SIZE = (160, 120)
SCARF = 0


def half_painted() -> str:
    """Return paint for the scarf that rises from 0 to 1 along its members."""
    return layer_paint.encode(np.linspace(0, 1, len(bear().gdfs[SCARF].region), dtype=np.float32))


def view(strength: float = 1.0, painted: str = layer_paint.FULL) -> ViewState:
    first = first_view(bear(), strength, 0.5)
    return replace(first, layers=(replace(first.layers[0], paint=painted), *first.layers[1:]))


def shown(engine: ViewEngine, state: ViewState, ctx: moderngl.Context) -> np.ndarray:
    """Draw to a screen and read it back. [H,W,3]"""
    screen = ctx.framebuffer([ctx.texture(SIZE, 4, dtype="f4")])
    engine.draw(state, screen, SIZE)
    return np.frombuffer(screen.read(components=3, dtype="f4"), np.float32).reshape(SIZE[1], SIZE[0], 3)[::-1]


def highlighted(scene: Gaussians, shade: Highlight) -> Gaussians:
    """Return a scene whose members have the mixed colors, as a plain reference."""
    members = bear().gdfs[shade.gdf].region.members
    over = (
        torch.from_numpy(
            highlight.highlight_colors(shade, bear().gdfs, len(scene))[members].astype(np.float32)
        )
        / 255.0
    )
    share = over[:, 3:]
    sh0 = scene.sh0.clone()
    shN = scene.shN.clone()
    sh0[members] = (1 - share) * sh0[members] + share * (over[:, :3] - 0.5) / C0
    shN[members] = (1 - share)[:, :, None] * shN[members]
    return replace(scene, sh0=sh0, shN=shN)


def test_ramp_rises_in_lightness_between_its_two_named_colors() -> None:
    ramp = highlight.ramp_colors(np.linspace(0, 1, 256, dtype=np.float32)).astype(float)
    assert tuple(ramp[0]) == (0x2B, 0x3F, 0xA8)
    assert tuple(ramp[-1]) == (0xF9, 0xE5, 0x58)
    lightness = ramp @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) > -1.0).all()
    assert lightness[-1] - lightness[0] > 120


def test_thin_tint_leaves_fully_weighted_members_untinted() -> None:
    members = bear().gdfs[SCARF].region.members.numpy()
    total = len(bear().scene)
    colors, tint = (
        highlight.highlight_colors(Highlight(SCARF, half_painted(), thin=thin), bear().gdfs, total)[members]
        for thin in (False, True)
    )
    assert (tint[:, :3] == colors[:, :3]).all()
    assert tint[:, 3].min() == 0
    assert 0 < tint[:, 3].max() < 0.5 * colors[:, 3].max()


@pytest.mark.gl
@pytest.mark.parametrize("draw", ["cpu", "gl"])
def test_highlight_equals_a_scene_with_mixed_colors(ctx: moderngl.Context, draw: str) -> None:
    shade = Highlight(SCARF, half_painted())
    engine = ViewEngine(ctx, bear().scene, bear().gdfs, draw)
    plain = ViewEngine(ctx, highlighted(engine.gaussians(view(1.0, shade.paint)), shade), (), draw)
    expected = shown(plain, replace(view(), layers=()), ctx)
    before = shown(engine, view(1.0, shade.paint), ctx)
    engine.highlight = shade
    assert engine.needs_draw(view(1.0, shade.paint), SIZE)
    found = shown(engine, view(1.0, shade.paint), ctx)
    assert np.abs(found - before).max() > 0.2
    # highlight colors are 8 bits on the CPU and float on the GPU
    assert np.abs(found - expected).max() < 1e-4
    assert not engine.needs_draw(view(1.0, shade.paint), SIZE)
    engine.release()
    plain.release()


@pytest.mark.gl
def test_both_renderers_show_the_same_weights(ctx: moderngl.Context) -> None:
    images = []
    for draw in ("cpu", "gl"):
        engine = ViewEngine(ctx, bear().scene, bear().gdfs, draw)
        engine.highlight = Highlight(SCARF, half_painted())
        images.append(shown(engine, view(0.7), ctx))
        engine.release()
    assert np.sqrt(np.square(images[0] - images[1]).mean()) < 10 ** (-60 / 20)


@pytest.mark.gl
@pytest.mark.parametrize("draw", ["cpu", "gl"])
def test_painting_and_sliding_leave_no_residue(ctx: moderngl.Context, draw: str) -> None:
    engine = ViewEngine(ctx, bear().scene, bear().gdfs, draw)
    clean = shown(engine, view(0.6), ctx).copy()
    rng = np.random.default_rng(1)
    weights = np.ones(len(bear().gdfs[SCARF].region), np.float32)
    for step in range(12):
        weights[rng.integers(len(weights), size=9)] = rng.random()
        painted = layer_paint.encode(weights)
        engine.highlight = Highlight(step % 5 == 4, painted if step % 5 < 4 else layer_paint.FULL)
        state = view(float(rng.choice([0.0, 0.3, 1.0])), painted)
        found = shown(engine, state, ctx)
        fresh = ViewEngine(ctx, bear().scene, bear().gdfs, draw)
        fresh.highlight = engine.highlight
        assert np.array_equal(found, shown(fresh, state, ctx)), step
        assert np.array_equal(
            engine.image(state, SIZE), ViewEngine(ctx, bear().scene, bear().gdfs, draw).image(state, SIZE)
        )
    engine.highlight = None
    assert np.array_equal(shown(engine, view(0.6), ctx), clean)


@pytest.mark.gl
@pytest.mark.parametrize("draw", ["cpu", "gl"])
def test_hidden_splats_are_removed_also_from_saved_pictures(ctx: moderngl.Context, draw: str) -> None:
    scene = bear().scene
    mask = np.arange(len(bear().scene)) % 3 == 0
    engine = ViewEngine(ctx, scene, bear().gdfs, draw)
    clean = shown(engine, view(0.6), ctx).copy()
    some = replace(view(0.6), selection=selection.hide(SelectionState(), mask))
    found = shown(engine, some, ctx).copy()
    kept = torch.from_numpy(~mask)
    less = ViewEngine(ctx, engine.gaussians(some)[kept.nonzero()[:, 0]], (), draw)
    assert np.abs(found - shown(less, replace(view(), layers=()), ctx)).max() < 1e-5
    shown_as = 0.51 / 255.0 if draw == "cpu" else 1e-5  # 8 bits per channel on the CPU, float on the GPU
    assert np.abs(engine.image(some, SIZE) - found).max() < shown_as
    slid = replace(some, layers=view(1.0).layers)
    shown(engine, slid, ctx)
    assert np.array_equal(shown(engine, some, ctx), found), "a slider brings nothing back"
    assert np.array_equal(shown(engine, view(0.6), ctx), clean)
    engine.release()
    less.release()


@pytest.mark.gl
@pytest.mark.parametrize("draw", ["cpu", "gl"])
def test_selection_has_a_full_tint_with_a_tool_and_a_trace_without(ctx: moderngl.Context, draw: str) -> None:
    members = bear().gdfs[SCARF].region.members
    mask = np.zeros(len(bear().scene), bool)
    mask[members] = True
    chosen = selection.select(SelectionState(), mask)
    still = replace(view(0.6), selection=chosen)
    trace = Highlight(tinted=((chosen.members, highlight.SELECTED, highlight.FAINT_TINT),))
    assert highlight.requested_highlight(still, 0) == trace
    assert highlight.requested_highlight(still, 0, looks=True) is None
    assert highlight.requested_highlight(replace(still, panel=False), 0) is None
    tinted = highlight.requested_highlight(replace(still, select=SelectTool("lasso")), 0)
    assert tinted == Highlight(tinted=((chosen.members, highlight.SELECTED, highlight.TINT),))
    assert highlight.requested_highlight(still, 0, ("selection", 0)) == tinted
    with_tool = replace(still, select=SelectTool("lasso"))
    for graded in (still, with_tool):
        assert highlight.requested_highlight(graded, 0, graded=True) is None, "a tint falsifies the grade"
    assert highlight.requested_highlight(still, 0, ("selection", 0), graded=True) == tinted
    assert highlight.requested_highlight(still, 0, ("layer", SCARF)) == Highlight(region=SCARF)
    engine = ViewEngine(ctx, bear().scene, bear().gdfs, draw)
    engine.highlight = tinted
    found = shown(engine, still, ctx)
    engine.highlight = Highlight(region=SCARF)
    assert np.array_equal(shown(engine, still, ctx), found), "a layer's region is tinted as a selection"
    engine.highlight = None
    assert np.abs(shown(engine, still, ctx) - found).max() > 0.1
    engine.release()


@pytest.mark.gl
def test_selection_tint_is_off_while_the_form_changes_the_picture(hand: Rig) -> None:
    main_view, everything = hand.main_view, np.ones(len(bear().scene), bool)
    view = replace(main_view.work.view, selection=selection.select(SelectionState(), everything))

    def is_tinted(tool: str, form_open: bool = True) -> bool:
        work = replace(main_view.work, view=replace(view, select=SelectTool(tool)), form_open=form_open)
        main_view.store.replace(work)
        hand.frame(2)
        return main_view.engine.highlight is not None

    assert is_tinted("")
    main_view.store.replace(with_transient(main_view.work, live=(LayerState(0, "what the form says", 1.0),)))
    assert not is_tinted("")
    assert not is_tinted("lasso"), "it is the form that changes the picture"
    hand.move(300.0, 300.0)
    hand.press()
    hand.settle()
    assert main_view.engine.highlight is not None, "one sees what one selects"
    hand.release()
    assert is_tinted("lasso", form_open=False), "of a training behind it too"
    assert not is_tinted("", form_open=False)


def test_visible_regions_keep_their_colors_below_the_selection() -> None:
    mask = np.arange(len(bear().scene)) % 2 == 0
    kept = selection.add_region(selection.select(SelectionState(), mask), "even", Path("even.region.npy"))
    region = replace(kept.regions[0], visible=True)
    kept = selection.change_region(selection.select(kept, np.arange(len(mask)) < 10), 0, region)
    requested = highlight.requested_highlight(replace(view(), selection=kept, select=SelectTool("box")), 0)
    assert requested is not None
    colors = highlight.highlight_colors(requested, (), len(mask))
    assert (colors[:10, :3] == np.round(255 * np.array(highlight.SELECTED))).all()
    assert (colors[10:, 3] > 0).tolist() == mask[10:].tolist()
    assert (colors[12, :3] == np.round(255 * np.array(region.color))).all()


def test_weights_are_highlighted_while_painting_a_visible_layer() -> None:
    out = replace(view(), brush=Brush(active=True))
    assert highlight.requested_highlight(out, 0) == Highlight(0, layer_paint.FULL, thin=True)
    colors = replace(out, brush=Brush(active=True, weights=True))
    assert highlight.requested_highlight(colors, 0) == Highlight(0, layer_paint.FULL)
    for without in (
        view(),
        replace(out, compare=Comparison("split")),
        replace(out, layers=(replace(out.layers[0], enabled=False), *out.layers[1:])),
    ):
        assert highlight.requested_highlight(without, 0) is None
    assert highlight.requested_highlight(out, None) is None
    assert highlight.requested_highlight(out, 7) is None


@pytest.mark.gl
def test_c_shows_all_weights_but_not_in_saved_pictures() -> None:
    with rig(replace(first_view(bear(), 1.0, 1.0), brush=Brush(active=True)), (700, 640)) as hand:
        plain = hand.picture().astype(int)
        saved = hand.main_view.canvas.image(hand.main_view.work.view, (400, 640))
        assert np.abs(np.clip(saved, 0, 1) * 255 - plain)[100:].max() < 1.0, "below the brush's ring"
        hand.key("C")
        assert hand.main_view.work.view.brush.weights
        assert np.abs(hand.picture().astype(int) - plain).max() > 60
        again = hand.main_view.canvas.image(hand.main_view.work.view, (400, 640))
        assert (again == saved).all()
        hand.key("C")
        assert (hand.picture() == plain).all()
        assert hand.main_view.work.past.past == (), "looking is no edit"


@pytest.mark.gl
def test_hovering_a_layer_thumbnail_shows_its_region() -> None:
    scarf = bear().gdfs[0]
    stack = Stack(bear().demo, (scarf, replace(scarf, name="frost")))
    with rig(first_view(stack, 0.5, 0.5), (700, 640), stack=stack) as hand:
        before = hand.picture().astype(int)
        saved = hand.main_view.work.past
        hand.move(700 - 300 + 52, HEAD)
        hand.pause(1.0)
        hand.frame(2)
        assert hand.main_view.work.pointed == ("layer", 1), "the upper layer's card is the first"
        assert np.abs(hand.picture() - before).max() > 60
        hand.move(700 - 300 + 60, TRACK)
        hand.frame(3)
        assert hand.main_view.work.pointed is None
        assert (hand.picture() == before).all()
        assert hand.main_view.work.past == saved
