"""Table of commands and its lists: complete, readable in the smallest window, never covered by a message."""

from __future__ import annotations

import json
import sys
import webbrowser
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from imgui_bundle import imgui

from progdf.io.atomic import state_folder
from tests.helpers.null_app import null_app, press
from tests.helpers.scenes import random_gaussians
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from tests.viewer.app.test_keys_of_lists_and_form import strike, type_text
from viewer.camera.view_camera import first_camera
from viewer.files import exports
from viewer.files.document import empty
from viewer.panel.tools import paint_obstacle
from viewer.state import actions, selection, timeline
from viewer.state.commands import Plain
from viewer.state.view_state import ViewState
from viewer.ui import key_list
from viewer.ui.context import SMALL_PX
from viewer.ui.keys import COMMANDS, JOINED, KEYS, bind, shortcut
from viewer.ui.search import WORDS, find_commands

SMALLEST = (1024, 640)


def test_every_command_has_a_name_and_keys_have_a_row() -> None:
    listed = [row for topic in key_list.topics()[1:] for row in topic.rows]
    assert len(listed) == len(set(listed))
    for command in COMMANDS.values():
        text = command.row or command.name
        keys = {key for key, does in listed if does == command.row}
        assert (text in [does for _, does in listed]) == (bool(command.keys) and text != JOINED), command
        assert not command.listed or keys == {command.listed}
    assert {("Ctrl+G", "Group; Shift ungroups"), ("Ctrl+C, Ctrl+V", "Copy, paste keys")} <= {*listed}
    assert all(topic.rows for topic in key_list.topics())
    assert all(command.name for command in COMMANDS.values())


INTERNAL = {
    *("save_to", "open_file", "browse", "discard", "overwrite", "restore_autosave", "discard_autosave"),
    *("train", "paint_over", "stop_run", "resume_run", "ask_discard", "discard_run", "close_run", "run_log"),
    *("show_file", "copy_path", "deliver", "stop_and_quit", "drop_and_quit", "rebind", "rebind_from"),
    *("replace_by", "place", "keep_placed", "put_back", "lay_decal", "save_region", "rename_region"),
    *("press_layer", "master", "rename_group", "restore", "forget", "name_snapshot", "keep_run"),
    *("move_snapshot", "choose_snapshot", "region", "show_region", "forget_region"),
    *("select_invert", "choose_keys", "move_keys", "clone_keys"),
    *("seek", "length", "fps", "go_to", "example", "forget_file", "use_view", "keep_view"),
    *("carry_on", "look_behind", "refine_anyway", "fill_hole", "true_length", "keep_pull", "leave_pull"),
    *("add_file", "show_scene", "select_scene", "move_scene", "reset_scene", "rename_scene", "remove_scene"),
    *("stop_making", "stop_search", "test_editor", "allow_outside", "save_look", "set_blend"),
}
"""Actions of buttons, questions and drags that need an argument, so the command palette omits them."""


@pytest.mark.gl
def test_every_action_is_a_command_or_internal(tmp_path: Path) -> None:
    with null_app(empty(), ViewState(), tmp_path) as app:
        everything = {*app.requests, *exports.REQUESTS}
    everything |= {*actions.ACTIONS, *timeline.ACTIONS, *actions.OF_EDITS, *selection.CHANGES}
    everything |= {"frame", "home", "invert", "flip_up"}
    everything |= {"paint_clear", "paint_fill", "paint_invert", "paint_feather"}
    everything |= {"next_slider", "point", "point_press"}
    named = {command.action.name for command in COMMANDS.values()}
    assert named | INTERNAL == everything
    assert not named & INTERNAL


@pytest.mark.parametrize(
    ("query", "first"),
    [
        ("undo", "undo"),
        ("split", "split"),
        ("sv", "split"),  # initials
        ("web", "export_page"),
        ("rend pic", "render_picture"),
        ("ctrl+shift+p", "render_film"),
        ("expscn", "export"),  # letters in their order
        ("object middle subject", "select_subject"),  # words of its name and help, in any order
    ],
)
def test_command_is_found_by_parts_of_its_name(query: str, first: str) -> None:
    assert find_commands(query, COMMANDS)[0].id == first


FIRST_GUESSES = {
    "hue": "new_edit",
    "erase": "remove_selected",
    "mask": "select_tool:lasso",
    "layer": "new_edit",
    "opacity": "fold",
    "LUT": "open",
    "turntable": "render_film",
    "crop": "isolate",
    "screenshot": "picture",
    "video": "render_film",
    "share": "export_page",
    "before": "split",
    "brightness": "new_grade",
    "grade": "new_grade",
    "magic wand": "select_tool:flood",
    "rotate": "move_selected",
    "sticker": "decal",
    "shortcuts": "help",
    "ruler": "measure",
    "zoom to fit": "frame",
    "heal": "paint_tool:clone",
    "black and white": "new_grade",
    "sharpen": "new_grade",
    "background color": "view_settings",
    "fov": "view_settings",
    "upside down": "flip_up",
    "top view": "look:top",
    "recent": "open",
    "exit": "quit",
    "watermark": "decal",
    "walkthrough": "timeline",
    "expand selection": "select_grow",
    "delete object": "remove_selected",
    "denoise": "hide_strays",
    "spz": "export",
}
"""First words that a newcomer may type for a task, and the command of the task."""
VISIBLE_ROWS = 3  # rows at which one looks before typing another word


def test_first_guesses_of_newcomers_find_their_command() -> None:
    missed = [
        query
        for query, command in FIRST_GUESSES.items()
        if command not in [found.id for found in find_commands(query, COMMANDS)[:VISIBLE_ROWS]]
    ]
    assert missed == []


def test_everyday_words_belong_to_commands() -> None:
    assert {*WORDS} <= {*COMMANDS}


def test_unknown_query_finds_nothing_and_empty_query_finds_all() -> None:
    assert find_commands("xyzzy", COMMANDS) == []
    assert {command.id for command in find_commands("", COMMANDS)} == {*COMMANDS}


@pytest.mark.gl
def test_command_palette_works_by_typing_arrows_and_enter() -> None:
    with rig(None, (900, 700)) as hand:
        before = hand.main_view.work.view
        strike(hand, "Ctrl+P")
        assert hand.main_view.work.palette == 0
        type_text(hand, "view")
        found = [command.id for command in find_commands("view", COMMANDS)]
        for chord in ("Down", "Down", "Up"):
            strike(hand, chord)
        assert hand.main_view.work.palette == 1
        assert hand.main_view.work.view == before, "no letter was a shortcut"
        strike(hand, "Escape")
        assert hand.main_view.work.palette is None
        strike(hand, "F3")
        type_text(hand, "ground")
        strike(hand, "Enter")
        assert hand.main_view.work.palette is None
        assert hand.main_view.work.view == replace(before, grid=True)
        strike(hand, "G")
        assert hand.main_view.work.view.unfolded, "shortcuts are back"
        assert len(found) > 2


@pytest.mark.gl
def test_click_beside_the_palette_closes_it_and_on_a_line_runs_it() -> None:
    with rig(None, (900, 700)) as hand:
        hand.key("F3")
        hand.click(40.0, 650.0)
        assert hand.main_view.work.palette is None
        hand.key("F3")
        type_text(hand, "ground")
        hand.click(*hand.at("grid"))
        assert hand.main_view.work.view.grid


@pytest.mark.gl
def test_key_list_opens_and_closes_by_f1_and_escape() -> None:
    with rig(None, (900, 700)) as hand:
        for chord in ("F1", "Escape"):
            strike(hand, "F1")
            assert hand.main_view.work.help
            strike(hand, chord)
            assert not hand.main_view.work.help


@pytest.mark.gl
def test_key_list_is_searched_and_closed_by_its_button() -> None:
    with rig(None, (1024, 640)) as hand:
        hand.key("F1")
        assert not hand.io.want_text_input, "keys stay active"
        hand.click(*hand.at("##search keys"))
        type_text(hand, "shrink")
        assert hand.main_view.work.help_query == "shrink"
        assert [topic.name for topic in key_list.find_rows("shrink")] == ["Select"]
        assert key_list.find_rows("brush ctrl") == ()
        hand.click(*hand.at("close"))
        assert not hand.main_view.work.help
        hand.key("F1")
        assert not hand.main_view.work.help_query


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_columns_keep_all_topics_in_order_and_are_balanced(count: int) -> None:
    topics = key_list.topics()
    found = key_list.columns(topics, count)
    assert len(found) <= count
    assert tuple(topic for column in found for topic in column) == topics
    longest = max(sum(topic.height for topic in column) for column in found)
    assert longest <= sum(topic.height for topic in topics) / count + max(t.height for t in topics)


@pytest.fixture
def own_keys() -> Iterator[None]:
    """Restore the default keys after the test."""
    yield
    bind({})


@pytest.mark.usefixtures("own_keys")
def test_bound_keys_replace_defaults_and_are_taken_from_others() -> None:
    given = {"snapshot": "f6", "beside": ["shift+ctrl+J", "Y"], "quit": "", "difference": "T", "before": "B"}
    assert bind(given) == []
    found = {
        action: [chord for chord, command in KEYS.items() if command.id == action] for action in COMMANDS
    }
    assert (found["snapshot"], found["beside"], found["quit"]) == (["F6"], ["Ctrl+Shift+J", "Y"], [])
    assert (found["timeline"], found["brush"]) == ([], []), "T and B do something else now"
    assert found["undo"] == ["Ctrl+Z"]
    assert (shortcut("snapshot"), shortcut("quit")) == ("F6", "")
    rows = {does: keys for topic in key_list.topics() for keys, does in topic.rows}
    assert (rows["Add snapshot"], rows["Compare snapshots"]) == ("F6", "Shift+F5"), "each in a row of its own"
    assert "Quit" not in rows
    assert bind({}) == []
    assert shortcut("snapshot") == "F5"


@pytest.mark.usefixtures("own_keys")
def test_message_names_the_bound_key_or_none() -> None:
    view = ViewState(first_camera(random_gaussians(20)))
    assert paint_obstacle(view, None) == "no layer is selected; click one, or press 1 for the first"
    assert bind({"focus:1": "Alt+9"}) == []
    assert paint_obstacle(view, None).endswith("or press Alt+9 for the first")
    assert bind({"focus:1": ""}) == []
    assert paint_obstacle(view, None) == "no layer is selected; click one"


WRONG = {
    "snapsot": ("F6", "there is no such command"),
    "snapshot": ("F13", "there is no key F13"),
    "undo": ("Ctrl+", "there is no key Ctrl+"),
    "redo": ("Hyper+Z", "there is no key Hyper+Z"),
    "split": (["Y", 7], 'keys are written as "F6" or ["F6", "Ctrl+B"]'),
    "hide": ({"key": "H"}, 'keys are written as "F6" or ["F6", "Ctrl+B"]'),
    "solo": ("F7", "F7 is already assigned to lock"),
    "fold": ("w", "W is a flight key"),
}


@pytest.mark.usefixtures("own_keys")
def test_invalid_key_binding_is_reported_and_keeps_the_old_one() -> None:
    before = dict(KEYS)
    problems = bind({"lock": "F7", **{action: value for action, (value, _) in WRONG.items()}})
    assert problems == [f"{action}: {line}" for action, (_, line) in WRONG.items()]
    assert {chord: key for chord, key in KEYS.items() if key.id != "lock"} == {
        chord: key for chord, key in before.items() if key.id != "lock"
    }


@pytest.mark.gl
@pytest.mark.usefixtures("own_keys")
def test_keys_file_is_created_complete_and_read_on_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    with null_app(opened_document(bear_files(tmp_path)), first_view(bear(), 0.5, 0.5), tmp_path) as app:
        app.main_view.messages.request(Plain("keys_file"))
        app.draw()
        path = state_folder() / "keys.json"
        assert opened == [path.as_uri()]
        assert [*json.loads(path.read_text())] == [*COMMANDS]
        before = dict(KEYS)
        app.parts.file_actions.bind_keys()
        assert before == KEYS, "as it was made it changes nothing"
        assert app.main_view.work.message is not None
        assert app.main_view.work.message.text.startswith("Keys are read from")
        path.write_text('{"grid": "F8", "undo": 3, "nothing": "F9"}')
        app.parts.file_actions.bind_keys()
        message = 'keys.json: undo: keys are written as "F6" or ["F6", "Ctrl+B"], and 1 more in window.log'
        assert app.main_view.work.message.text == message
        assert "nothing: there is no such command" in (state_folder() / "window.log").read_text()
        press(app, "Shift+G")
        assert not app.main_view.work.view.grid
        press(app, "F8")
        assert app.main_view.work.view.grid
        for damaged in ("{", "[1]", "\xff"):
            path.write_bytes(damaged.encode("latin-1"))
            app.parts.file_actions.bind_keys()
            assert "keys.json is damaged" in app.main_view.work.message.text
            assert before == KEYS


def shown(hand: Rig) -> imgui.internal.Window:
    """Return the window of the key list."""
    return imgui.internal.find_window_by_name("keys")


def rows_of(hand: Rig) -> imgui.internal.Window:
    """Return the scrolling part of the key list."""
    windows = imgui.get_current_context().windows
    return next(window for window in windows if window.name.startswith("keys/rows"))


@pytest.mark.gl
@pytest.mark.parametrize(
    ("points", "density", "scale"), [(SMALLEST, 1.0, 1.0), (SMALLEST, 2.0, 1.0), ((2048, 1280), 1.0, 2.0)]
)
def test_whole_key_list_is_readable_in_the_smallest_window(
    points: tuple[int, int], density: float, scale: float
) -> None:
    with rig(None, points, density, scale) as hand:
        hand.key("F1")
        hand.frame(2)
        topics_window = shown(hand)
        assert rows_of(hand).scroll_max.y == 0.0
        assert rows_of(hand).scroll_max.x == 0.0
        assert topics_window.pos.y >= 0.0
        assert topics_window.pos.y + topics_window.size.y <= points[1]
        assert fits_its_columns(hand)


def fits_its_columns(hand: Rig) -> bool:
    """Return True if every line fits its column."""
    imgui.new_frame()
    imgui.push_font(hand.main_view.ui.fonts.regular, SMALL_PX)
    room = (key_list.COLUMN_PX - 8.0) * hand.main_view.ui.scale
    fits = all(
        max(imgui.calc_text_size(chord).x for topic in column for chord, _ in topic.rows)
        + 14.0 * hand.main_view.ui.scale
        + max(imgui.calc_text_size(does).x for topic in column for _, does in topic.rows)
        <= room
        for column in key_list.columns(key_list.topics(), key_list.MAX_COLUMNS)
    )
    imgui.pop_font()
    imgui.end_frame()
    return fits


@pytest.mark.gl
@pytest.mark.parametrize("times", [1, 4, 16])
def test_message_of_several_lines_stays_below_the_key_list(times: int) -> None:
    with rig(None, SMALLEST) as hand:
        hand.key("F1")
        hand.main_view.messages.show("a line that is long enough to be wrapped " * times)
        hand.frame(3)
        topics_window = shown(hand)
        message = imgui.internal.find_window_by_name("message")
        assert topics_window.pos.y + topics_window.size.y <= message.pos.y
        assert times > 4 or rows_of(hand).scroll_max.y == 0.0


@pytest.mark.gl
def test_key_list_scrolls_to_its_end_in_a_too_small_window() -> None:
    with rig(None, (640, 400)) as hand:
        hand.key("F1")
        hand.frame(2)
        before = hand.main_view.work.view.camera
        assert rows_of(hand).scroll_max.y > 0.0
        for _ in range(40):
            hand.wheel(320.0, 200.0, -2.0)
        assert rows_of(hand).scroll.y == rows_of(hand).scroll_max.y
        assert hand.main_view.work.view.camera == before, "the wheel over it zooms nothing"


def test_command_key_acts_as_ctrl_on_a_mac(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from viewer.ui import window

    assert window.chord("S", window.glfw.MOD_SUPER) == "S"
    assert not any("Cmd" in row for topic in key_list.topics() for row in topic.rows)
    monkeypatch.setattr(sys, "platform", "darwin")
    both = window.glfw.MOD_SUPER | window.glfw.MOD_SHIFT
    assert window.chord("S", both) == window.chord("S", window.glfw.MOD_CONTROL | window.glfw.MOD_SHIFT)
    assert window.chord("S", both) == "Ctrl+Shift+S"
    assert any("Cmd" in row for topic in key_list.topics() for row in topic.rows)
