"""Selecting in the picture by scripted mouse: every tool, its modes, undo and the panel."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui

from progdf.scene.selection import inside_polygon, inside_rectangle, inside_stroke, project_centers
from progdf.scene.strays import find_strays
from tests.helpers.null_app import null_app, press
from tests.helpers.ui_rig import HEAD, Rig, bear, first_view, rig
from viewer.camera.view_camera import to_camera
from viewer.files.document import Document
from viewer.state import selection
from viewer.state.commands import Plain, WithText
from viewer.state.selection import SelectionState, unpack
from viewer.state.view_state import SelectTool
from viewer.ui import pointer

pytestmark = pytest.mark.gl
WINDOW = (700, 640)
MIDDLE = (200.0, 320.0)
ON_HEAD = (210.0, 190.0)
LASSO = ((120.0, 200.0), (300.0, 220.0), (290.0, 400.0), (210.0, 330.0), (110.0, 390.0))


@pytest.fixture
def hand() -> Iterator[Rig]:
    view = replace(first_view(bear(), 0.0, 0.0), select=SelectTool(through=True))
    with rig(view, WINDOW) as opened:
        yield opened


def selected(hand: Rig) -> np.ndarray:
    return unpack(hand.main_view.work.view.selection.members, len(bear().scene))


def points(hand: Rig) -> np.ndarray:
    """Return the projected centers of all Gaussians, pixels. [N,2]"""
    work = hand.main_view.work
    return project_centers(bear().scene, to_camera(work.view.camera, *hand.main_view.picture_size)).points


def drag_along(hand: Rig, path: Sequence[tuple[float, float]]) -> None:
    hand.move(*path[0])
    hand.press()
    for place in path[1:]:
        hand.move(*place)
    hand.release()


def undos(hand: Rig) -> int:
    return len(hand.main_view.work.past.past)


def test_box_selects_its_content_and_keeps_the_camera(hand: Rig) -> None:
    camera = hand.main_view.work.view.camera
    hand.key("R")
    hand.drag((120, 200), (260, 330))
    assert (selected(hand) == inside_rectangle(points(hand), (120, 200), (260, 330))).all()
    assert 0 < selected(hand).sum() == hand.main_view.work.view.selection.count
    assert hand.main_view.work.view.camera == camera
    assert undos(hand) == 1


def test_lasso_selects_the_enclosed_splats(hand: Rig) -> None:
    hand.key("L")
    drag_along(hand, LASSO)
    assert (selected(hand) == inside_polygon(points(hand), LASSO)).all()
    assert undos(hand) == 1
    hand.key("Ctrl+Z")
    assert not selected(hand).any()


def test_selection_leaves_a_trace_except_while_a_slider_moves(hand: Rig) -> None:
    plain = hand.picture()
    hand.key("L")
    drag_along(hand, LASSO)
    tinted = hand.picture()
    hand.key("L")
    hand.move(5.0, 5.0)
    trace = hand.picture()
    far, near = (np.abs(image.astype(int) - plain).mean() for image in (tinted, trace))
    assert 0 < near < far / 2
    hand.move(*hand.slider(0, 0.0))
    hand.press()
    hand.move(*hand.slider(0, 0.6))
    assert hand.main_view.engine.highlight is None
    hand.release()
    assert hand.main_view.engine.highlight is not None
    hand.key("F12")
    assert hand.main_view.engine.highlight is None, "without the panel one sees the scene alone"


@pytest.mark.parametrize("how", ["Enter", "double click", "first corner"])
def test_polygon_is_clicked_and_closed(hand: Rig, how: str) -> None:
    hand.key("P")
    for corner in LASSO:
        hand.click(*corner)
        hand.rest(1.0)
    assert not selected(hand).any()
    if how == "Enter":
        hand.key("Enter")
        assert hand.main_view.work.renaming is None
    elif how == "double click":
        hand.double_click(*LASSO[-1])
    else:
        hand.click(LASSO[0][0] + 3, LASSO[0][1])
    assert (selected(hand) == inside_polygon(points(hand), LASSO)).all()
    assert undos(hand) == 1


def test_escape_cancels_a_polygon_first_and_then_the_tool(hand: Rig) -> None:
    hand.key("P")
    for corner in LASSO:
        hand.click(*corner)
    gesture = hand.main_view.work.transient.tool.gesture
    assert gesture is not None
    assert len(gesture.path) == len(LASSO), "the state shows the polygon between its clicks"
    hand.key("Escape")
    assert hand.main_view.work.transient.tool.gesture is None
    assert hand.main_view.work.view.select.tool == "polygon"
    hand.click(300, 420)
    hand.key("Enter")
    assert not selected(hand).any()
    hand.key("Escape")
    assert hand.main_view.work.view.select.tool == ""
    assert hand.main_view.work.focus is not None
    hand.key("Escape")
    assert hand.main_view.work.focus is None


def test_escape_reverts_a_brush_stroke_in_progress(hand: Rig) -> None:
    hand.key("U")
    hand.move(*MIDDLE)
    hand.press()
    hand.move(MIDDLE[0] + 40, MIDDLE[1])
    assert selected(hand).any(), "a brush selects at once"
    hand.key("Escape")
    assert not selected(hand).any()
    hand.release()
    assert not selected(hand).any()
    assert undos(hand) == 0


def test_brush_selects_touched_splats(hand: Rig) -> None:
    hand.key("U")
    path = [(150.0, 250.0), (200.0, 320.0), (260.0, 330.0)]
    drag_along(hand, path)
    assert (selected(hand) == inside_stroke(points(hand), path, SelectTool.radius)).all()
    assert undos(hand) == 1


def test_sphere_is_drawn_from_its_center(hand: Rig) -> None:
    hand.key("Shift+R")
    hand.drag(MIDDLE, (MIDDLE[0] + 60, MIDDLE[1]))
    means = bear().scene.means.numpy()[selected(hand)]
    assert 5 < len(means) < len(bear().scene)
    assert (np.hypot(*(points(hand)[selected(hand)] - MIDDLE).T) < 75).all()
    assert undos(hand) == 1


def test_flood_selects_connected_and_color_tool_all_similar_splats(hand: Rig) -> None:
    hand.key("J")
    hand.click(*MIDDLE)
    flooded = selected(hand).copy()
    assert flooded.any()
    assert undos(hand) == 1
    hand.key("I")
    hand.click(*MIDDLE)
    assert (selected(hand) | ~flooded).all()
    assert selected(hand).sum() >= flooded.sum()


@pytest.mark.parametrize("tool", ["J", "I"])
def test_click_updates_with_its_tolerance_as_one_undo_step(hand: Rig, tool: str) -> None:
    hand.key("Ctrl+A")
    everything = selected(hand).copy()
    hand.key(tool)
    hand.modifier(imgui.Key.mod_ctrl)
    hand.click(*MIDDLE)
    hand.modifier(imgui.Key.mod_ctrl, False)
    taken = [(~selected(hand)).sum()]
    hand.drag(MIDDLE, (MIDDLE[0] + 60, MIDDLE[1]), 2)  # the tolerance stays with the clicked point
    for _ in range(3):
        hand.key("]")
        hand.frame(2)
        taken.append((~selected(hand)).sum())
    assert 0 < taken[0] < taken[-1]
    assert taken == sorted(taken)
    assert hand.main_view.work.view.select.tolerance > SelectTool.tolerance
    assert undos(hand) == 2
    hand.key("Ctrl+Z")
    assert (selected(hand) == everything).all()
    hand.key("[")
    assert (selected(hand) == everything).all(), "it is taken back, and follows no more"
    assert undos(hand) == 1


def test_shift_adds_ctrl_subtracts_and_both_intersect(hand: Rig) -> None:
    def box(*keys: imgui.Key, by: float = 0.0) -> np.ndarray:
        for key in keys:
            hand.modifier(key)
        hand.drag((120 + by, 200), (220 + by, 330))
        for key in keys:
            hand.modifier(key, False)
        return inside_rectangle(points(hand), (120 + by, 200), (220 + by, 330))

    hand.key("R")
    first = box()
    second = box(imgui.Key.mod_shift, by=60)
    assert (selected(hand) == first | second).all()
    third = box(imgui.Key.mod_ctrl, by=30)
    assert (selected(hand) == (first | second) & ~third).all()
    fourth = box(imgui.Key.mod_ctrl, imgui.Key.mod_shift, by=-20)
    assert (selected(hand) == (first | second) & ~third & fourth).all()
    assert undos(hand) == 4


def test_only_the_front_surface_is_selected_without_through(hand: Rig) -> None:
    hand.key("R")
    hand.drag((100, 150), (300, 400))
    through = selected(hand).sum()
    hand.key("N")
    hand.drag((100, 150), (300, 400))
    assert 0 < selected(hand).sum() < 0.8 * through


def test_precomputed_surface_selects_the_same(hand: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    hand.key("R")
    hand.key("N")
    found = []
    for many in (10**9, 1):
        monkeypatch.setattr(pointer, "PREPARE_MIN_GAUSSIANS", many)
        hand.frame()
        hand.drag((100, 150), (300, 400))
        found.append(selected(hand).copy())
    assert hand.main_view.surfaces.at(None) is None, "it was looked at"
    assert (found[0] == found[1]).all()
    assert found[0].any()


def test_click_beside_clears_the_selection_and_with_shift_keeps_it(hand: Rig) -> None:
    hand.key("R")
    hand.drag((120, 200), (260, 330))
    kept = selected(hand).copy()
    hand.modifier(imgui.Key.mod_shift)
    hand.click(5, 5)
    hand.modifier(imgui.Key.mod_shift, False)
    assert (selected(hand) == kept).all()
    hand.click(5, 5)
    assert not selected(hand).any()


def test_middle_and_right_drags_still_move_the_camera(hand: Rig) -> None:
    hand.key("L")
    before = hand.main_view.work.view.camera
    hand.drag(MIDDLE, (MIDDLE[0] + 30, MIDDLE[1]), 2)
    assert hand.main_view.work.view.camera.azimuth != before.azimuth
    hand.drag(MIDDLE, (MIDDLE[0] + 30, MIDDLE[1]), 1)
    assert hand.main_view.work.view.camera.pivot != before.pivot
    assert not selected(hand).any()


def test_selection_tool_and_brush_exclude_each_other(hand: Rig) -> None:
    hand.key("B")
    hand.key("L")
    view = hand.main_view.work.view
    assert (view.brush.active, view.select.tool) == (False, "lasso")
    hand.key("B")
    view = hand.main_view.work.view
    assert (view.brush.active, view.select.tool) == (True, "")
    hand.key("L")
    hand.key("L")
    assert hand.main_view.work.view.select.tool == "", "its key puts it down again"


def test_hidden_splats_are_neither_visible_nor_selectable(hand: Rig) -> None:
    plain = hand.picture().astype(int)
    hand.key("R")
    hand.drag((120, 200), (260, 330))
    was = selected(hand).copy()
    hand.key("Ctrl+H")
    assert hand.main_view.work.view.selection.count == 0
    assert np.abs(hand.picture().astype(int) - plain).max() > 60
    hand.drag((120, 200), (260, 330))
    assert not selected(hand).any()
    hand.key("Alt+H")
    hand.drag((120, 200), (260, 330))
    assert (selected(hand) == was).all()
    hand.key("Ctrl+Shift+H")
    hand.key("Escape")
    alone = hand.picture()
    assert (alone[:150] == alone[0, 0]).mean() > 0.9
    for _ in range(5):
        hand.key("Ctrl+Z")
    assert not hand.main_view.work.view.selection.hidden


def test_keys_change_the_whole_selection(hand: Rig) -> None:
    hand.key("Ctrl+A")
    assert selected(hand).all()
    hand.key("Ctrl+Shift+A")
    assert not selected(hand).any()
    hand.key("R")
    hand.drag((120, 200), (260, 330))
    before = selected(hand).copy()
    hand.key("Ctrl+]")
    assert selected(hand).sum() > before.sum()
    hand.key("Ctrl+[")
    hand.key("Ctrl+Z")
    hand.key("Ctrl+Z")
    assert (selected(hand) == before).all()
    hand.key("Ctrl+I")
    assert (selected(hand) == ~before).all()


def test_hovering_a_layer_name_shows_its_region(hand: Rig) -> None:
    before = hand.picture().astype(int)
    hand.move(WINDOW[0] - 300 + 90, HEAD)
    hand.pause(1.0)
    hand.frame(2)
    assert hand.main_view.work.pointed == ("layer", 1)
    assert np.abs(hand.picture() - before).max() > 30
    hand.move(*MIDDLE)
    hand.frame(3)
    assert hand.main_view.work.pointed is None
    assert (hand.picture() == before).all()


def test_panel_selects_shows_and_saves_regions() -> None:
    mask = bear().demo.labels.numpy() == 1
    kept = selection.add_region(selection.select(SelectionState(), mask), "scarf", Path("scarf.region.npy"))
    some = selection.select(kept, np.arange(len(mask)) < 100)
    view = replace(first_view(bear(), 0.7, 0.5), selection=some, select=SelectTool("lasso"))
    with rig(view, (1024, 640)) as hand:
        row = (850.0, 265.0)
        eye = (748.0, 265.0)
        save = (130.0, 61.0)
        hand.modifier(imgui.Key.mod_shift)
        hand.click(*row)
        hand.modifier(imgui.Key.mod_shift, False)
        assert (selected(hand) == mask | (np.arange(len(mask)) < 100)).all()
        hand.click(*row)
        assert (selected(hand) == mask).all()
        assert undos(hand) == 2
        plain = hand.picture()
        hand.click(*eye)
        assert hand.main_view.work.view.selection.regions[0].visible
        hand.key("Escape")
        assert (hand.picture() != plain).any()
        hand.key("L")
        hand.click(*save)
        hand.frame(3)
        hand.io.add_input_characters_utf8("hat")
        hand.frame(2)
        hand.modifier(imgui.Key.enter)
        hand.modifier(imgui.Key.enter, False)
        hand.frame(2)
        assert hand.main_view.take_requests() == (WithText("save_region", "hat"),)


def test_hide_strays_hides_them_and_undo_shows_them(tmp_path: Path) -> None:
    scene = replace(bear().scene, logit_opacities=bear().scene.logit_opacities.clone())
    scene.logit_opacities[:7] = -9.0
    with null_app(Document("a", scene), first_view(bear()), tmp_path) as app:
        app.parts.searches.patience_s = 0.0
        app.main_view.messages.request(Plain("hide_strays"))
        app.draw()
        assert "Looking for strays" in app.main_view.work.message.text
        while app.parts.searches.poll() is not None:
            time.sleep(0.05)
        hidden = unpack(app.main_view.work.view.selection.hidden, len(scene))
        assert np.array_equal(np.flatnonzero(hidden), find_strays(scene).rows)
        message = app.main_view.work.message.text
        assert message.startswith("Hid 7 strays (7 too transparent to be drawn): no pixel differs")
        press(app, "Ctrl+Z")
        assert not app.main_view.work.view.selection.hidden


def test_strays_of_a_closed_scene_hide_nothing(tmp_path: Path) -> None:
    with null_app(Document("a", bear().scene), first_view(bear()), tmp_path) as app:
        app.parts.searches.patience_s = 0.0
        app.handle(Plain("hide_strays"))
        app.documents.replace(Document("b", bear(1000).scene))
        while app.parts.searches.poll() is not None:
            time.sleep(0.05)
        assert not app.main_view.work.view.selection.hidden
        assert app.main_view.work.message is None


def test_strokes_on_and_beside_an_object_select_it(hand: Rig) -> None:
    """Select the head by a stroke on it and a Ctrl stroke over the body; another Ctrl stroke removes more."""

    def beside(path: Sequence[tuple[float, float]]) -> None:
        hand.modifier(imgui.Key.mod_ctrl)
        drag_along(hand, path)
        hand.modifier(imgui.Key.mod_ctrl, False)

    x, y = ON_HEAD
    hand.key("Shift+U")
    drag_along(hand, [(x - 30, y), (x, y), (x + 30, y)])
    stroke = selected(hand).copy()
    assert 0 < stroke.sum() < 100, "all that is known as yet"
    below = (x, y + 200)
    beside([(below[0] - 60, below[1]), below, (below[0] + 60, below[1])])
    first = selected(hand).copy()
    assert (first | ~stroke).all()
    assert stroke.sum() < first.sum() < 0.7 * len(first)
    dots = hand.picture()
    hand.key("Ctrl+Z")
    assert (selected(hand) == stroke).all()
    assert (hand.picture() != dots).any()
    hand.key("Ctrl+Y")
    assert (selected(hand) == first).all()
    beside([(below[0] - 60, below[1] - 60), (below[0] + 60, below[1] - 60)])
    assert selected(hand).sum() < first.sum(), "the strokes before count on"
    hand.key("Ctrl+Shift+A")
    drag_along(hand, [(below[0] - 20, below[1]), below])
    assert selected(hand).sum() < 100, "and no more once nothing is selected"
