"""Opening another scene replaces everything that belongs to the old scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui

from progdf.formats.ply import save_ply
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import bear_files, full_view, opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.app import app as application
from viewer.files import session
from viewer.files.session import WindowSession
from viewer.render.paint_overlay import packed_picture
from viewer.state import selection
from viewer.state.selection import NamedRegion, SelectionState, pack
from viewer.state.transient import PreviewState
from viewer.state.view_state import (
    Brush,
    ColorBrush,
    SceneState,
    SelectTool,
    SnapshotPair,
    ViewState,
    on_another_scene,
)
from viewer.state.workspace import mark_saved, new_workspace

OF_THE_WINDOW = {
    "safe_frame",
    "background",
    "panel",
    "dynamic_resolution",
    "grid",
    "axes",
    "cards",
}


def all_in_use(view: ViewState, count: int) -> ViewState:
    """Add a selection, hidden splats, a region of a scene of `count` Gaussians and an active brush."""
    half = np.arange(count) % 2 == 0
    third = np.arange(count) % 3 == 0
    region = NamedRegion("half", Path("half.region.npy"), pack(half), int(half.sum()), visible=True)
    chosen = SelectionState(pack(half & ~third), int((half & ~third).sum()), pack(third), (region,))
    return replace(view, selection=chosen, brush=Brush(active=True), unfolded=(0,), overshoot=True)


@pytest.fixture
def window(tmp_path: Path) -> Iterator[application.App]:
    folder = bear_files(tmp_path)
    save_ply(tmp_path / "half.ply", bear().scene[:700])
    with null_app(opened_document(folder), first_view(bear(), 0.5, 0.5), folder) as app:
        yield app


def test_new_scene_keeps_only_the_window_settings() -> None:
    view = all_in_use(full_view(), len(bear().scene))
    view = replace(view, panel=False, grid=True, select=SelectTool("flood"), overshoot=True)
    picture = packed_picture(view.camera, (2, 2), np.full((2, 2, 4), 255, np.uint8))
    view = replace(view, color_brush=ColorBrush("clone"), painted=(picture,))
    view = replace(view, dynamic_resolution="on", pair=SnapshotPair("1", "2"), safe_frame="1:1", mode="rings")
    view = replace(view, scenes=(SceneState(0, "bear"),))
    plain = ViewState()
    changed = {
        field.name for field in fields(ViewState) if getattr(view, field.name) != getattr(plain, field.name)
    }
    assert changed == {field.name for field in fields(ViewState)}, "every setting is another than at first"
    after = on_another_scene(view, plain.camera)
    for field in fields(ViewState):
        expected = view if field.name in OF_THE_WINDOW else plain
        assert getattr(after, field.name) == getattr(expected, field.name), field.name


@pytest.mark.gl
@pytest.mark.parametrize("tool", ["box", "polygon", "flood", "brush"])
def test_another_scene_opens_while_the_old_one_is_in_use(
    window: application.App, tmp_path: Path, tool: str
) -> None:
    main_view = window.main_view
    main_view.store.change(all_in_use(main_view.work.view, len(bear().scene)))
    if tool != "brush":
        press(window, {"box": "R", "polygon": "P", "flood": "J"}[tool])
    for place in (
        (150.0, 250.0),
        (250.0, 350.0),
    ):  # a drag in progress, or a click whose tolerance can still change
        imgui.get_io().add_mouse_pos_event(*place)
        imgui.get_io().add_mouse_button_event(0, True)
        window.draw()
        if tool in ("polygon", "flood"):
            imgui.get_io().add_mouse_button_event(0, False)
        window.draw()
    main_view.store.replace(mark_saved(replace(main_view.work, pointed=("region", 0), form_open=True)))
    window.parts.file_actions.open(tmp_path / "half.ply")
    assert len(window.documents.get().scene) == 700
    for place in ((200.0, 300.0), (240.0, 360.0)):
        imgui.get_io().add_mouse_pos_event(*place)
        main_view.wake()
        window.draw()
    imgui.get_io().add_mouse_button_event(0, False)
    press(window, "J", "]", "F", "Ctrl+A", "Ctrl+H", "Alt+H", "Escape")
    work = main_view.work
    fresh = new_workspace(ViewState())
    selection.check(work.view.selection, 700)
    assert work.view.selection.regions == ()
    assert not work.view.brush.active
    assert (work.form_open, work.form, work.player) == (fresh.form_open, fresh.form, fresh.player)
    assert (main_view.work.transient.cover, main_view.work.transient.preview) == (None, PreviewState())


@pytest.mark.gl
def test_scene_that_cannot_be_opened_keeps_the_old_one(
    window: application.App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window.main_view.store.change(all_in_use(window.main_view.work.view, len(bear().scene)))
    window.main_view.store.replace(mark_saved(window.main_view.work))
    before = window.main_view.work.view
    engine = window.engine

    def no_engine(*_: object) -> None:
        raise OSError(28, "No space left on device", "half.ply")

    monkeypatch.setattr(window, "_engine", no_engine)
    window.parts.file_actions.open(tmp_path / "half.ply")
    window.draw()
    assert (window.main_view.work.view, window.engine) == (before, engine)
    assert window.documents.get().path == tmp_path / "bear.ply"


@pytest.mark.gl
def test_session_restores_its_selection_without_an_active_tool(tmp_path: Path) -> None:
    folder = bear_files(tmp_path)
    opened = opened_document(folder)
    view = all_in_use(replace(first_view(bear(), 0.5, 0.5), select=SelectTool("box")), len(bear().scene))
    session.save(folder / "all.session.json", WindowSession(opened, view))
    with null_app(opened, first_view(bear(), 0.5, 0.5), folder) as app:
        app.parts.file_actions.open(folder / "all.session.json")
        press(app, "F")
        shown = app.main_view.work.view
        assert (shown.selection.count, shown.overshoot) == (view.selection.count, True)
        assert (shown.brush.active, shown.select.tool) == (False, "")
