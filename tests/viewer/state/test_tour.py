"""Tour of the window: the user's actions finish its steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.helpers.ui_rig import bear, first_view
from viewer.state import workspace
from viewer.state.forms import EDITORS, NewEdit
from viewer.state.transient import Strokes, Tour
from viewer.state.workspace import Dialog, Workspace, new_workspace, with_tool, with_transient

GRADE = next(i for i, editor in enumerate(EDITORS) if editor.setting == "grade")


def running(name: str) -> Workspace:
    """Return a workspace in this step of the tour."""
    work = workspace.start_tour(new_workspace(first_view(bear(), 0.5, 0.5)))
    for _ in range(workspace.STEP_NAMES.index(name)):
        work = workspace.skip_step(work)
    return work


def done(name: str) -> Workspace:
    """Return the workspace after the user has done this step."""
    work = running(name)
    view = work.view
    match name:
        case "move":
            return replace(work, view=replace(view, camera=replace(view.camera, distance=9.0)))
        case "slide":
            return replace(work, view=replace(view, layers=(replace(view.layers[0], strength=0.7),)))
        case "scribble":
            rows = np.arange(3)
            return with_tool(work, strokes=(Strokes(rows, rows, b"", b"", b""),))
        case "grade":
            return replace(work, form=NewEdit(editor=GRADE), form_open=True)
    return replace(work, dialog=Dialog("export_page"))


def test_each_action_finishes_its_own_step_only() -> None:
    for name in workspace.STEP_NAMES[:-1]:
        for step in workspace.STEP_NAMES:
            work = with_transient(done(step), tour=running(name).transient.tour)
            after = workspace.follow_tour(work, held=False).transient.tour
            assert isinstance(after, Tour)
            assert (after.step > workspace.STEP_NAMES.index(name)) == (step == name), (name, step)


def test_step_lasts_until_the_mouse_button_is_released() -> None:
    for name in workspace.STEP_NAMES:
        work = done(name)
        assert workspace.follow_tour(work, held=True) is work


def test_tour_ends_after_the_last_step_or_when_it_is_skipped() -> None:
    for ended in (workspace.follow_tour(done("share"), held=False), workspace.end_tour(running("slide"))):
        assert ended.transient.tour is None
        assert ended.layout.toured


def test_next_step_starts_with_the_present_state() -> None:
    moved = workspace.follow_tour(done("move"), held=False)
    assert workspace.follow_tour(moved, held=False) is moved
    work = with_transient(done("slide"), tour=Tour(1, workspace.TOUR_STEPS["slide"](done("slide"))))
    assert workspace.follow_tour(work, held=False) is work
