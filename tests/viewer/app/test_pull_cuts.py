"""Cuts of the Pull tool: lines drawn by the mouse, removed by clicks, and kept out of other keys."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from imgui_bundle import imgui

from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.app.app import App
from viewer.state import selection
from viewer.state.transient import Pull, PullCut, PullPose
from viewer.state.workspace import with_transient
from viewer.ui.glfw_library import glfw

from .test_pulling import button, drag, frame, means, move, on_scarf, pull_of

pytestmark = pytest.mark.gl


@pytest.fixture
def app(folder: Path) -> Iterator[App]:
    with null_app(opened_document(folder), first_view(bear()), folder) as app:
        yield app


def draw_line(app: App, start: tuple[float, float], end: tuple[float, float]) -> None:
    move(app, *start)
    button(app, True)
    for share in np.linspace(0.1, 1.0, 10):
        move(app, start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1]))
    button(app, False)


def across_chest(app: App) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends of a line across the bear, below the middle of the scarf."""
    x, y = on_scarf(app)
    return (x - 200.0, y + 45.0), (x + 200.0, y + 45.0)


def hold_shift(app: App, down: bool) -> None:
    imgui.get_io().add_key_event(imgui.Key.mod_shift, down)
    frame(app)


def set_whole(app: App) -> None:
    pull = replace(pull_of(app), whole=True)
    app.main_view.store.replace(with_transient(app.main_view.work, gizmo=pull))


def test_cut_leaves_the_other_side_in_place(app: App) -> None:
    before = means(app)
    camera = app.main_view.work.view.camera
    press(app, "Shift+P")
    set_whole(app)
    drag(app, on_scarf(app), (0.0, -30.0))
    together = (means(app) != before).any(dim=1)
    press(app, "Ctrl+Z", "K")
    draw_line(app, *across_chest(app))
    (cut,) = pull_of(app).pose.cuts
    assert len(cut.points) > 5
    assert app.main_view.work.view.camera == camera, "a line that begins beside the scene turns nothing"
    press(app, "K")
    drag(app, on_scarf(app), (0.0, -30.0))
    pull = pull_of(app)
    assert pull.influence is not None
    assert pull.influence.is_cut
    apart = (means(app) != before).any(dim=1)
    assert int(apart.sum()) < 0.9 * int(together.sum())
    live = means(app)
    press(app, "Enter")
    app.parts.pulling.settle()
    app.draw()
    kept = (means(app) != before).any(dim=1)
    assert not kept[~apart].any(), "the layer is cut like its preview"
    assert float((means(app) - live).norm(dim=1).max()) < 0.1 * float((live - before).norm(dim=1).max())
    press(app, "Ctrl+Z")
    assert torch.equal(means(app), before)


def test_cuts_are_undone_cleared_and_removed_by_a_click(app: App) -> None:
    press(app, "Shift+P", "K")
    start, end = across_chest(app)
    draw_line(app, start, end)
    draw_line(app, (start[0], start[1] - 20.0), (end[0], end[1] - 20.0))
    first, second = pull_of(app).pose.cuts
    press(app, "Ctrl+Z")
    assert pull_of(app).pose.cuts == (first,)
    press(app, "Ctrl+Y")
    assert pull_of(app).pose.cuts == (first, second)
    hold_shift(app, True)
    x, y = on_scarf(app)
    move(app, x, y + 25.0)
    button(app, True)
    button(app, False)
    hold_shift(app, False)
    assert pull_of(app).pose.cuts == (first,)
    move(app, x, y)
    button(app, True)
    button(app, False)
    assert pull_of(app).pose.cuts == (first,), "a click is no cut"
    assert not pull_of(app).pose.pins


def test_escape_ends_the_line_then_the_cuts_then_the_tool(app: App) -> None:
    press(app, "Shift+P", "K")
    start, end = across_chest(app)
    move(app, *start)
    button(app, True)
    move(app, *end)
    assert pull_of(app).stroke is not None
    press(app, "Escape")
    assert pull_of(app).stroke is None
    assert pull_of(app).is_cutting
    button(app, False)
    assert not pull_of(app).pose.cuts
    press(app, "Escape")
    assert not pull_of(app).is_cutting
    press(app, "Escape")
    assert not isinstance(app.main_view.work.transient.gizmo, Pull)


def test_line_on_the_background_is_no_cut(app: App) -> None:
    press(app, "Shift+P", "K")
    draw_line(app, (80.0, 150.0), (120.0, 200.0))
    assert not pull_of(app).pose.cuts


def test_bar_stays_within_a_narrow_picture(app: App) -> None:
    glfw.set_window_size(app.window.handle, 800, 600)
    mask = np.zeros(app.main_view.facts.count, bool)
    mask[bear().demo.members("scarf")] = True
    view = app.main_view.work.view
    app.main_view.store.change(replace(view, selection=selection.select(view.selection, mask)))
    press(app, "Shift+P", "K")
    cut = PullCut((0.0, 0.0, 9.0), ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    pull = replace(pull_of(app), pose=PullPose(cuts=(cut,)))
    app.main_view.store.replace(with_transient(app.main_view.work, gizmo=pull))
    frame(app)
    frame(app)
    bar = imgui.internal.find_window_by_name("placing")
    assert bar is not None
    assert bar.pos.x > 0.0
    assert bar.pos.x + bar.size.x < app.main_view._area().width
