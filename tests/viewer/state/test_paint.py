"""Painted strength: strokes as pure functions, by mouse, as session text, and across edits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from imgui_bundle import imgui

from progdf.camera import Camera
from progdf.compose import layer_paint
from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.scene.selection import Surface
from tests.helpers.edits import growing, some_rows, whole_grade
from tests.helpers.scenes import random_gaussians
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.camera.view_camera import to_camera
from viewer.files.document import Document
from viewer.files.session import WindowSession, prune
from viewer.state import paint
from viewer.state.paint import Stroke, near_mean
from viewer.state.view_state import LARGEST_PX, Brush, LayerState, ViewState

POINTS = (700, 640)
LINE = Stroke(
    np.ones(5, np.float32),
    np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0], [40, 0, 0], [np.nan, np.nan, np.nan]], np.float32),
    np.zeros(5, np.float32),
)
ERASE = Brush(active=True, radius=20.0, softness=0.5)


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(replace(first_view(bear(), 1.0, 1.0), brush=ERASE), POINTS) as opened:
        opened.key("2")  # the lower layer, the scarf
        yield opened


def weights(hand: Rig, layer: int = 0) -> np.ndarray:
    found = layer_paint.decode(hand.main_view.work.view.layers[layer].paint, len(bear().gdfs[layer].region))
    return np.ones(len(bear().gdfs[layer].region)) if found is None else found.numpy()


def camera_of(hand: Rig) -> Camera:
    return to_camera(hand.main_view.work.view.camera, POINTS[0] - 300, POINTS[1])


def scarf_on_screen(hand: Rig) -> tuple[float, float]:
    camera = camera_of(hand)
    members = bear().gdfs[0].region.members
    x, y, z = (camera.viewmat[:3, :3] @ bear().scene.means[members].mean(0) + camera.viewmat[:3, 3]).tolist()
    return float(camera.K[0, 0] * x / z + camera.K[0, 2]), float(camera.K[1, 1] * y / z + camera.K[1, 2])


def test_paint_round_trips_within_a_255th_and_full_paint_is_empty() -> None:
    drawn = torch.rand(300, generator=torch.Generator().manual_seed(0)).numpy()
    found = layer_paint.decode(layer_paint.encode(drawn), 300)
    assert found is not None
    assert np.abs(found.numpy() - drawn).max() <= 0.5 / 255 + 1e-6
    assert layer_paint.encode(np.ones(300, np.float32)) == layer_paint.FULL
    assert layer_paint.decode(layer_paint.FULL, 300) is None


@pytest.mark.parametrize(
    "text", ["no base64!", "AAAA", *(layer_paint.encode(np.zeros(n, np.float32)) for n in (4, 7))]
)
def test_damaged_paint_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ProgdfError, match="paint it again"):
        layer_paint.decode(text, 5)


def test_paint_may_lack_only_rows_that_other_edits_add() -> None:
    found = layer_paint.decode(layer_paint.encode(np.zeros(5, np.float32)), 7, 2)
    assert found is not None
    assert found.tolist() == [0.0] * 5 + [1.0] * 2
    with pytest.raises(ProgdfError, match="do not fit its 7 members; paint it again"):
        layer_paint.decode(layer_paint.encode(np.zeros(4, np.float32)), 7, 2)


def test_brush_is_full_inside_and_fades_to_its_radius() -> None:
    stroke = paint.extend_stroke(LINE, 0.0, 0.0, ERASE)
    assert stroke.reached.tolist() == pytest.approx([1.0, 1.0, 0.0, 0.0, 0.0])
    hazy = paint.extend_stroke(LINE, 0.0, 0.0, replace(ERASE, softness=1.0))
    assert hazy.reached.tolist() == pytest.approx([1.0, 0.5, 0.0, 0.0, 0.0])
    dense = paint.extend_stroke(LINE, 0.0, 0.0, ERASE, density=4.0)
    assert dense.reached[3] == 1.0, "the radius is in pixels at 1×"


def test_stroke_does_not_depend_on_the_number_of_events() -> None:
    whole = paint.extend_stroke(paint.extend_stroke(LINE, -20.0, 0.0, ERASE), 25.0, 0.0, ERASE)
    steps = LINE
    for x in np.linspace(-20.0, 25.0, 31):
        steps = paint.extend_stroke(steps, float(x), 0.0, ERASE)
    assert steps.reached == pytest.approx(whole.reached, abs=1e-5)


def result(stroke: Stroke, brush: Brush = ERASE, mode: str = "erase") -> np.ndarray:
    found = layer_paint.decode(paint.apply_stroke(replace(stroke, mode=mode), brush), len(stroke.before))
    return np.ones(len(stroke.before)) if found is None else found.numpy()


def test_erase_and_add_follow_the_brush_coverage() -> None:
    before = np.array([0.0, 1.0, 0.5, 0.25, 0.75], np.float32)
    stroke = replace(LINE, before=before, reached=np.array([1, 1, 0.5, 0, 0], np.float32))
    assert result(stroke, mode="erase").tolist() == pytest.approx([0.0, 0.0, 0.25, 0.25, 0.75], abs=0.003)
    assert result(stroke, mode="add").tolist() == pytest.approx([1.0, 1.0, 0.75, 0.25, 0.75], abs=0.003)


def test_flow_scales_the_stroke_and_value_is_the_target_of_add() -> None:
    before = np.full(5, 0.5, np.float32)
    stroke = replace(LINE, before=before, reached=np.ones(5, np.float32))
    added = result(stroke, Brush(flow=0.5, value=0.9), "add")
    assert added.tolist() == pytest.approx([0.7] * 5, abs=0.003)
    erased = result(stroke, Brush(flow=0.5, value=0.9), "erase")
    assert erased.tolist() == pytest.approx([0.25] * 5, abs=0.003)


def test_inverting_paint_twice_restores_it() -> None:
    some = layer_paint.encode(np.array([0.0, 0.2, 1.0], np.float32))
    assert layer_paint.decode(paint.invert(some, 3), 3).tolist() == pytest.approx([1.0, 0.8, 0.0], abs=0.003)
    assert paint.invert(paint.invert(some, 3), 3) == some
    assert paint.invert(paint.invert(layer_paint.FULL, 3), 3) == layer_paint.FULL


def test_ctrl_i_inverts_the_paint_of_the_layer_as_one_undo_entry(hand: Rig) -> None:
    hand.key("Ctrl+I")
    assert weights(hand).max() == 0.0
    assert len(hand.main_view.work.past.past) == 1
    hand.key("Ctrl+Z")
    assert weights(hand).min() == 1.0


def step_under_a_brush(behind: float = 0.0) -> Stroke:
    """Return touched weights that step from 0 to 1 along x; the part with 1 lies `behind` units deeper."""
    x = np.arange(-40, 40, dtype=np.float32)
    places = np.stack([x, np.zeros_like(x), np.where(x < 0, 0.0, behind)], 1).astype(np.float32)
    return Stroke((x >= 0).astype(np.float32), places, np.ones(80, np.float32))


def test_smoothing_turns_a_step_into_a_local_ramp() -> None:
    brush = Brush(active=True, radius=20.0, softness=0.5, mode="smooth")
    smooth = result(step_under_a_brush(), brush, "smooth")
    assert smooth[:15].max() < 0.01
    assert smooth[-15:].min() > 0.99, "what is far from the step keeps its weight"
    assert 0.3 < smooth[39] < smooth[40] < 0.7
    assert (np.diff(smooth) >= -1 / 255).all()
    small = result(step_under_a_brush(), replace(brush, radius=5.0), "smooth")
    assert np.abs(np.diff(small)).max() > 2 * np.abs(np.diff(smooth)).max(), "a small brush smooths narrowly"


def test_smoothing_ignores_points_that_are_close_only_on_screen() -> None:
    brush = Brush(active=True, radius=20.0, softness=0.5, mode="smooth")
    apart = step_under_a_brush(behind=200.0)
    assert result(apart, brush, "smooth") == pytest.approx(apart.before, abs=0.003)


def test_smoothing_changes_only_touched_and_uneven_weights() -> None:
    brush = Brush(active=True, radius=20.0, softness=0.5, mode="smooth")
    step = step_under_a_brush()
    half = replace(step, reached=(step.places[:, 0] < 10).astype(np.float32))
    assert (result(half, brush, "smooth")[step.places[:, 0] >= 10] == 1.0).all()
    even = replace(step, before=np.full(80, 0.6, np.float32))
    assert result(even, brush, "smooth") == pytest.approx(np.full(80, 0.6), abs=0.003)


def test_neighbor_mean_stays_in_range_and_ignores_the_grid_offset() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(4000, 3)).astype(np.float32)
    values = rng.random(4000).astype(np.float32)
    means = [near_mean(points + np.float32(shift), values, 0.5) for shift in (0.0, 0.13, 0.31)]
    for mean in means:
        assert values.min() <= mean.min() <= mean.max() <= values.max()
        assert mean.std() < 0.3 * values.std()
        assert np.abs(mean - means[0]).mean() < 0.05
    assert len(near_mean(points[:0], values[:0], 0.5)) == 0


def test_feathering_softens_painted_edges_and_keeps_full_paint(hand: Rig) -> None:
    hand.key("Shift+X")
    assert hand.main_view.work.view.layers[0].paint == layer_paint.FULL
    x, y = scarf_on_screen(hand)
    hand.main_view.store.replace(
        replace(
            hand.main_view.work, view=replace(hand.main_view.work.view, brush=replace(ERASE, softness=0.0))
        )
    )
    hand.drag((x - 15, y), (x + 15, y))
    hard = weights(hand)
    assert set(np.unique(hard)) == {0.0, 1.0}
    away = []
    for _ in range(2):
        hand.key("Shift+X")
        away.append(np.abs(weights(hand) - hard).sum())
    assert 0.0 < away[0] < away[1]
    assert ((weights(hand) > 0.05) & (weights(hand) < 0.95)).sum() > 5
    assert len(hand.main_view.work.past.past) == 3
    for _ in range(2):
        hand.key("Ctrl+Z")
    assert (weights(hand) == hard).all()


@pytest.mark.parametrize(
    ("mode", "modifier", "does"),
    [
        ("add", "Ctrl", "erase"),
        ("erase", "Ctrl", "add"),
        ("smooth", "Ctrl", "smooth"),
        ("erase", "", "erase"),
    ],
)
def test_ctrl_paints_the_opposite(mode: str, modifier: str, does: str) -> None:
    assert paint.mode_while(mode, modifier) == does


def test_shift_held_at_the_press_smooths_for_one_stroke(hand: Rig) -> None:
    x, y = scarf_on_screen(hand)
    hand.drag((x - 15, y), (x, y))
    hard = weights(hand)
    hand.modifier(imgui.Key.mod_shift)
    hand.drag((x - 15, y), (x, y))
    hand.modifier(imgui.Key.mod_shift, False)
    assert weights(hand).min() > hard.min(), "smoothing brings some back"
    assert hand.main_view.work.view.brush.mode == "erase"


def test_front_brush_skips_hidden_members_and_through_brush_does_not(hand: Rig) -> None:
    gdf = bear().gdfs[0]
    scene = bear().scene
    surface = Surface(scene, camera_of(hand))
    front = paint.begin_stroke(layer_paint.FULL, gdf, surface, through=False)
    through = paint.begin_stroke(layer_paint.FULL, gdf, surface, through=True)
    assert not np.isnan(through.places).any()
    hidden = np.isnan(front.places[:, 0])
    assert 0.2 < hidden.mean() < 0.8, "a scarf goes around the neck"
    camera = camera_of(hand)
    depth = (scene.means[gdf.region.members] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[:, 2].numpy()
    assert depth[hidden].mean() > depth[~hidden].mean()


def test_stroke_removes_the_edit_there_as_one_undo_entry(hand: Rig) -> None:
    camera = hand.main_view.work.view.camera
    before = hand.picture()
    x, y = scarf_on_screen(hand)
    hand.drag((x - 15, y), (x + 15, y))
    assert hand.main_view.work.view.camera == camera, "the left button paints"
    assert weights(hand).min() < 0.02
    assert weights(hand, 1).min() == 1.0, "only the focused layer"
    assert len(hand.main_view.work.past.past) == 1
    expected = compose_layers(
        bear().scene,
        [Layer(bear().gdfs[0], 1.0, weights=torch.from_numpy(weights(hand))), Layer(bear().gdfs[1], 1.0)],
    )
    assert torch.allclose(
        hand.main_view.engine.gaussians(hand.main_view.work.view).sh0, expected.sh0, atol=1e-6
    )
    assert np.abs(hand.picture().astype(int) - before).max() > 20
    hand.key("Ctrl+Z")
    assert hand.main_view.work.view.layers[0].paint == layer_paint.FULL


def test_locked_hidden_or_missing_layer_is_not_painted(hand: Rig) -> None:
    x, y = scarf_on_screen(hand)
    for chords, told in (
        (["Shift+L"], "locked"),
        (["H"], "hidden"),
        (["Escape", "Escape", "B"], "selected"),
    ):
        for chord in chords:
            hand.key(chord)
        hand.drag((x, y), (x + 5, y))
        assert weights(hand).min() == 1.0
        assert hand.main_view.work.message is not None
        assert told in hand.main_view.work.message.text
        hand.key(chord)
        hand.pause(0.5)


def test_brush_keys_match_the_brush_controls(hand: Rig) -> None:
    hand.key("B")
    assert not hand.main_view.work.view.brush.active
    for chord in ("B", "X", "Shift+B", "]", "Shift+["):
        hand.key(chord)
    assert hand.main_view.work.view.brush == Brush(True, 25.0, 0.4, "smooth", True)
    for _ in range(40):
        hand.key("]")
    assert hand.main_view.work.view.brush.radius == LARGEST_PX
    hand.key("Backspace")
    assert weights(hand).max() == 0.0
    hand.key("Shift+Backspace")
    assert hand.main_view.work.view.layers[0].paint == layer_paint.FULL
    assert hand.main_view.work.past.past[0].edit.layers[0].paint == layer_paint.FULL


def test_paint_survives_rows_added_and_removed_by_another_edit() -> None:
    scene = random_gaussians(90, seed=2, sh_degree=1)
    drawn = np.linspace(0, 0.8, 90, dtype=np.float32)
    edits = whole_grade(scene), growing(scene, some_rows(scene, 10, 1), 25, 7)
    layers = (LayerState(0, "dark", paint=layer_paint.encode(drawn)),)
    document = Document("s", scene, edits, gdf_paths=(Path("dark.gdf"), Path("hat.gdf")))
    with_hat = layer_paint.layer_of(document.gdfs[0], 1.0, layers[0].gains, layers[0].paint).weights
    assert with_hat is not None
    assert with_hat.tolist() == pytest.approx([*drawn, *np.ones(25)], abs=0.003)
    for gdf, count in zip(document.gdfs, (89, 34), strict=True):  # the hat's own rows are painted with it
        with pytest.raises(ProgdfError, match="paint it again"):
            layer_paint.layer_of(gdf, 1.0, layers[0].gains, layer_paint.encode(np.zeros(count, np.float32)))
    wider = replace(layers[0], paint=layer_paint.encode(with_hat.numpy()))
    pruned = prune(WindowSession(document, ViewState(layers=(wider,))))
    assert pruned.view.layers == layers
    assert len(pruned.document.scene) == 90
