"""Layout of the window: tools, options bar, comparison pill, panel width, cards and jobs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from imgui_bundle import imgui

from progdf.io.atomic import state_folder
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.stacks import many_edits
from tests.helpers.ui_rig import HEAD, Rig, bear, first_view, rig
from viewer.panel import card, panel, tools
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.selection import SelectionState
from viewer.state.view_state import ViewState
from viewer.state.workspace import WIDEST_PX, JobCard, Layout
from viewer.ui.context import LAYER_PADDING_PX, PANEL_PADDING_PX

pytestmark = pytest.mark.gl
SIZE = (1280, 800)
LEFT = SIZE[0] - panel.WIDTH_PX
ACTIONS = [action for group in tools._TOOLS for action, *_ in group]


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(first_view(bear(), 0.5, 0.5), SIZE) as opened:
        yield opened


def tool_place(action: str) -> tuple[float, float]:
    """Return the window position of a tool's button."""
    above = next(i for i, group in enumerate(tools._TOOLS) if action in [name for name, *_ in group])
    return 28.0, 12.0 + 16.0 + 32.0 * ACTIONS.index(action) + 6.0 * above


def window_at(name: str) -> imgui.internal.Window:
    found = imgui.get_current_context().windows
    return next(window for window in found if window.name == name and window.active)


def test_tool_buttons_activate_and_deactivate_tools(hand: Rig) -> None:
    for action in ACTIONS[2:9]:
        hand.click(*tool_place(action))
        assert f"select_tool:{hand.main_view.work.view.select.tool}" == action
    hand.click(*tool_place("brush"))
    assert hand.main_view.work.view.brush.active
    assert hand.main_view.work.view.select.tool == ""
    hand.click(*tool_place("navigate:fly"))
    view = hand.main_view.work.view
    assert (view.camera.mode, view.brush.active) == ("fly", False)
    hand.click(*tool_place("select_tool:box"))
    hand.click(*tool_place("navigate:orbit"))
    view = hand.main_view.work.view
    assert (view.camera.mode, view.select.tool) == ("orbit", "")
    hand.click(*tool_place("move_selected"))
    assert hand.main_view.take_requests() == (), "nothing is selected"
    hand.click(*tool_place("decal"))
    assert hand.main_view.take_requests() == (Plain("decal"),)


def test_options_bar_appears_with_a_tool_or_a_selection() -> None:
    mask = bear().demo.labels.numpy() == 1
    view = replace(first_view(bear(), 0.5), selection=selection.select(SelectionState(), mask))
    with rig(view, SIZE) as hand:
        assert window_at("options").size.y < 50.0, "one line"
        hand.key("Ctrl+Shift+A")
        hand.settle()
        assert not any(w.name == "options" and w.active for w in imgui.get_current_context().windows)
        for chord in ("L", "J", "B"):
            hand.key(chord)
            bar = window_at("options")
            axes = window_at("view")
            assert bar.size.y < 50.0
            assert bar.pos.x + bar.size.x < axes.pos.x, "it covers neither the axes nor the panel"
            assert window_at("comparison").pos.y >= bar.pos.y + bar.size.y
    with rig(view, (1000, 700)) as hand:
        hand.key("B")
        hand.frame(2)
        bar = window_at("options")
        assert 50.0 < bar.size.y < 90.0, "two lines, where one does not do"
        assert bar.pos.x + bar.size.x < window_at("view").pos.x


@pytest.mark.parametrize("count", [9, 10])
def test_cards_become_rows_if_the_last_card_would_be_cut(count: int) -> None:
    stack, view = many_edits(bear(), count)
    with rig(view, (1280, 800), stack=stack) as hand:
        assert hand.main_view.work.cards_fit == (count == 9)


def test_six_layers_have_whole_cards_without_scrolling() -> None:
    stack, view = many_edits(bear(), 6)
    with rig(view, SIZE, stack=stack) as hand:
        assert hand.main_view.work.cards_fit
        body = next(
            w for w in imgui.get_current_context().windows if "body_" in w.name and "card" not in w.name
        )
        assert body.scroll_max.y == 0.0
        cards = [w for w in imgui.get_current_context().windows if "/card_" in w.name and w.active]
        assert len(cards) == 6
        assert max(window.size.y for window in cards) <= 64.0


def test_comparison_pill_shows_the_original_and_splits_the_view(hand: Rig) -> None:
    hand.click(*hand.at("left"))
    assert hand.main_view.work.before
    hand.click(*hand.at("right"))
    assert not hand.main_view.work.before
    hand.click(*hand.at("split"))
    assert hand.main_view.work.view.compare.mode == "split"
    hand.click(*hand.at("split"))
    assert hand.main_view.work.view.compare.mode == "off"


def test_sections_fold_and_open(hand: Rig) -> None:
    hand.click(*hand.at("section Edits"))
    assert "Edits" in hand.main_view.work.layout.folded
    hand.click(LEFT + 100.0, HEAD + card.CARD_PX)
    assert hand.main_view.work.focus == 1, "no card is there"
    hand.click(*hand.at("section Edits"))
    assert "Edits" not in hand.main_view.work.layout.folded


def test_panel_edge_is_dragged_within_its_limits(hand: Rig) -> None:
    hand.drag((LEFT + 2.0, 600.0), (LEFT - 98.0, 600.0))
    assert hand.main_view.work.layout.panel_px == 398.0
    assert hand.main_view.picture_size[0] == SIZE[0] - 398
    hand.drag((SIZE[0] - 396.0, 600.0), (100.0, 600.0))
    assert hand.main_view.work.layout.panel_px == WIDEST_PX
    hand.pause(0.5)
    hand.double_click(SIZE[0] - WIDEST_PX + 2.0, 600.0)
    assert hand.main_view.work.layout == Layout()
    assert hand.strengths == [0.5, 0.5]


def test_layout_is_remembered(tmp_path: Path) -> None:
    document = opened_document(bear_files(tmp_path))
    for zoom in (1.0, 1.1):
        with null_app(document, ViewState(), tmp_path) as app:
            assert app.main_view.work.layout.zoom == zoom
            press(app, "Ctrl+=")
            assert app.main_view.ui.scale == pytest.approx(app.window.ui_scale * zoom * 1.1, rel=1e-3)
    with null_app(document, ViewState(), tmp_path) as app:
        press(app, "Ctrl+0")
    (state_folder() / "layout.json").write_text('{"zoom": 99}')
    with null_app(document, ViewState(), tmp_path) as app:
        assert app.main_view.work.layout == Layout(), "what makes no sense is not followed"


def test_cards_are_a_multiple_of_8_pixels_apart(hand: Rig) -> None:
    apart = hand.box("eye", 1).top - hand.box("eye").top
    assert apart == card.CARD_PX
    assert apart % 8 == 0.0
    assert hand.box("##strength").left % 8 == (LEFT + PANEL_PADDING_PX[0] + LAYER_PADDING_PX[0]) % 8


def test_footer_keeps_its_place_above_selected_layers_and_jobs(hand: Rig) -> None:
    place = hand.box("help")
    hand.key("Ctrl+Alt+A")
    assert hand.box("help") == place, "below the slider of several layers"
    job = JobCard(1, "Film film.mp4", Path("/scenes/film.mp4"), "running")
    hand.main_view.store.replace(replace(hand.main_view.work, jobs=(job,)))
    hand.frame(3)
    assert hand.box("help") == place, "below the strip of jobs"
    hand.click(*hand.at("strip"))
    hand.frame(3)
    assert hand.box("help") == place, "below the unfolded cards"


def test_jobs_strip_opens_by_click_and_once_by_a_failure(hand: Rig) -> None:
    def cards() -> int:
        hand.frame(3)
        return sum(
            "jobs" in w.name and "/card_" in w.name and w.active for w in imgui.get_current_context().windows
        )

    hand.main_view.store.replace(
        replace(hand.main_view.work, jobs=(JobCard(1, "Film film.mp4", Path("/scenes/film.mp4"), "running"),))
    )
    assert cards() == 0
    hand.click(*hand.at("strip"))
    assert cards() == 1
    hand.click(*hand.at("strip"))
    assert cards() == 0
    hand.main_view.store.replace(
        replace(
            hand.main_view.work,
            jobs=(JobCard(1, "Film film.mp4", Path("/scenes/film.mp4"), "failed", error="no room"),),
        )
    )
    assert cards() == 1
    hand.click(*hand.at("strip"))
    assert cards() == 0, "what was seen does not open it again"


def test_card_shows_its_toggles_only_while_hovered(hand: Rig) -> None:
    assert card.TOGGLE_PX * 5 < 0.4 * panel.WIDTH_PX
    hand.move(LEFT + 100.0, HEAD)
    hand.frame(3)
    lit = hand.image()[round(HEAD) - 6 : round(HEAD) + 6, SIZE[0] - 160 : SIZE[0] - 60].astype(int)
    hand.move(300.0, 700.0)
    hand.frame(3)
    plain = hand.image()[round(HEAD) - 6 : round(HEAD) + 6, SIZE[0] - 160 : SIZE[0] - 60].astype(int)
    assert (abs(lit - plain).max(axis=-1) > 60).sum() > 100
    assert abs(plain - plain[0, 0]).max() < 3


def test_session_name_is_shown_in_the_window_and_the_panel(tmp_path: Path) -> None:
    with null_app(opened_document(bear_files(tmp_path)), ViewState(), tmp_path) as app:
        assert (app.main_view.work.session, app._title) == ("", "bear.ply – ProGDF Studio")
        app.parts.file_actions.save(tmp_path / "two looks.session.json")
        press(app, "F5")
        assert app.main_view.work.session == "two looks"
        assert app._title == "• two looks – ProGDF Studio"
