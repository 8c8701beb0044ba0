"""Layers made in another thread: progress, cancellation, and errors."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.errors import ProgdfError
from tests.helpers.edits import bits
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.app.app import App
from viewer.app.parts import tidy as tidy_part
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.transient import Gizmo, Pull
from viewer.state.view_state import ViewState
from viewer.state.workspace import with_transient

from .test_pulling import drag, frame, place_of, pull_of

pytestmark = pytest.mark.gl
SHIFT = (0.5, 0.25, -0.125)


@pytest.fixture
def app(folder: Path) -> Iterator[App]:
    with null_app(opened_document(folder), first_view(bear()), folder) as app:
        mask = np.zeros(app.main_view.facts.count, bool)
        mask[bear().demo.members("scarf")] = True
        view = app.main_view.work.view
        app.main_view.store.change(replace(view, selection=selection.select(view.selection, mask)))
        app.parts.maker.patience_s = 0.0
        yield app


@dataclass(frozen=True)
class Gate:
    """Stop in the middle of making a layer."""

    reached: threading.Event = field(default_factory=threading.Event)
    opened: threading.Event = field(default_factory=threading.Event)


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Gate:
    """Return a gate that the making of a layer waits at, after half of its work."""
    gate = Gate()
    make = tidy_part.tidy

    def wait(*arguments: object, **options: object) -> object:
        progress = options.get("progress")
        if callable(progress):
            progress(0.5)
            gate.reached.set()
            gate.opened.wait()
            progress(0.6)
        return make(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(tidy_part, "tidy", wait)
    return gate


def keep_moved(app: App) -> Gizmo:
    """Move the selection and keep it; return the handles before."""
    press(app, "Alt+M")
    gizmo = app.main_view.work.transient.gizmo
    assert isinstance(gizmo, Gizmo)
    matrix = np.eye(4)
    matrix[:3, 3] = SHIFT
    gizmo = replace(gizmo, matrix=matrix)
    app.main_view.store.replace(with_transient(app.main_view.work, gizmo=gizmo))
    app.main_view.messages.request(Plain("place"))
    app.draw()
    press(app, "Enter")
    return gizmo


def select_none(view: ViewState) -> ViewState:
    return replace(view, selection=selection.select_none(view.selection))


def text(app: App) -> str:
    message = app.main_view.work.message
    return "" if message is None else message.text


def names(app: App) -> list[str]:
    return [layer.name for layer in app.main_view.work.view.layers]


def test_window_goes_on_while_a_layer_is_made(app: App, gate: Gate) -> None:
    before = names(app)
    keep_moved(app)
    gate.reached.wait()
    app.parts.maker.poll()
    assert text(app) == "Making “moved” … 50 %"
    assert names(app) == before
    assert app.main_view.work.transient.gizmo is None
    assert [layer.name for layer in app.main_view.work.transient.live] == ["moved"], "it is still drawn"
    press(app, "Alt+M")
    app.parts.maker.poll()
    assert text(app).startswith("“moved” is still being made"), "one at a time"
    gate.opened.set()
    app.parts.maker.wait()
    app.draw()
    assert names(app) == [*before, "moved"]
    assert text(app) == "“moved” is ready"
    assert not app.main_view.work.transient.live
    members = bear().demo.members("scarf")
    moved = app.engine.gaussians(app.main_view.work.view).means[members] - bear().scene.means[members]
    assert torch.allclose(moved, torch.tensor(SHIFT), atol=1e-4)


@pytest.mark.parametrize("canceled", [False, True])
def test_pull_is_prepared_while_a_layer_is_made(app: App, gate: Gate, canceled: bool) -> None:
    before = names(app)
    keep_moved(app)
    gate.reached.wait()
    press(app, "Shift+P")
    assert isinstance(app.main_view.work.transient.gizmo, Pull)
    legs = bear().demo.members("legs")
    x, y = place_of(app, int(legs[bear().scene.means[legs, 2].argmax()]))
    app.main_view.store.change(select_none(app.main_view.work.view))
    drag(app, (x, y), (20.0, 0.0))
    assert [layer.name for layer in app.main_view.work.transient.live] == ["moved", "pulled"]
    pose = pull_of(app).pose
    assert pose.handles
    press(app, "Enter")
    assert text(app).startswith("“moved” is still being made"), "one at a time"
    assert pull_of(app).pose == pose, "the handles stay"
    if canceled:
        app.main_view.messages.request(Plain("stop_making"))
        app.draw()
    gate.opened.set()
    app.parts.maker.wait()
    frame(app)
    made = before if canceled else [*before, "moved"]
    assert names(app) == made
    assert pull_of(app).pose == pose
    assert [layer.name for layer in app.main_view.work.transient.live] == ["pulled"]
    press(app, "Enter")
    app.parts.pulling.settle()
    app.draw()
    assert names(app) == [*made, "pulled"]


def test_canceled_layer_returns_to_the_handles(app: App, gate: Gate) -> None:
    before = names(app)
    original = bits(bear().scene)
    kept = keep_moved(app)
    app.main_view.messages.request(Plain("stop_making"))
    app.draw()
    gate.opened.set()
    app.parts.maker.wait()
    app.draw()
    assert text(app) == "“moved” was canceled"
    assert names(app) == before
    gizmo = app.main_view.work.transient.gizmo
    assert isinstance(gizmo, Gizmo)
    assert np.array_equal(gizmo.matrix, kept.matrix)
    press(app, "Escape")
    assert not app.main_view.work.transient.live
    assert bits(app.documents.get().original) == original
    assert not list(app.documents.get().file.parent.rglob("moved*.gdf"))


def test_failure_returns_to_the_handles(app: App, gate: Gate, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ProgdfError("the disk is full")

    monkeypatch.setattr(tidy_part, "save_gdf", fail)
    keep_moved(app)
    gate.opened.set()
    with pytest.raises(ProgdfError, match="the disk is full"):
        app.parts.maker.wait()
    assert isinstance(app.main_view.work.transient.gizmo, Gizmo)


def test_another_scene_cancels_the_layer(app: App, gate: Gate) -> None:
    before = names(app)
    keep_moved(app)
    app.parts.leave_scene()
    gate.opened.set()
    app.draw()
    assert not app.parts.maker.is_busy
    assert names(app) == before
