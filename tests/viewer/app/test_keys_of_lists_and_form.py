"""An open list, menu, question or new-edit form takes all keys."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import HEAD, Rig, bear, first_view, rig
from viewer.panel import panel
from viewer.state.commands import Plain
from viewer.state.forms import DeliverOptions
from viewer.state.selection import NamedRegion
from viewer.state.workspace import Dialog
from viewer.ui.keys import KEYS, Keys, Press, next_event_id
from viewer.ui.search import jump_to
from viewer.ui.splash import Splash
from viewer.ui.window import Window, glfw

pytestmark = pytest.mark.gl

WINDOW = (900, 700)
LIST = (780.0, 139.0)
"""Window position of the form's region list."""
NAMES = ("Right", "Left", "Up", "Down", "Enter", "Escape", "Tab", "Space", "Backspace", "Delete")
TOKENS = {
    **{
        name: getattr(imgui.Key, f"{name.lower()}_arrow" if i < 4 else name.lower())
        for i, name in enumerate(NAMES)
    },
    **{letter.upper(): getattr(imgui.Key, letter) for letter in "abcdefghijklmnopqrstuvwxyz"},
}
MODIFIERS = {"Ctrl": imgui.Key.mod_ctrl, "Shift": imgui.Key.mod_shift, "Alt": imgui.Key.mod_alt}


def strike(hand: Rig, chord: str) -> None:
    """Send a key to imgui and to the table of bindings, as the window does."""
    *held, name = chord.split("+")
    for down in (True, False):
        for modifier in held:
            hand.io.add_key_event(MODIFIERS[modifier], down)
        press = Press(chord, event_id=next_event_id())
        if name in TOKENS:
            hand.io.add_key_event(TOKENS[name], down)
        hand.main_view.wake()
        hand.frame(keys=Keys((press,) * down, frozenset({name} if down else ())))
    hand.settle()


def type_text(hand: Rig, text: str) -> None:
    for letter in text:
        hand.io.add_input_characters_utf8(letter)
        strike(hand, "Space" if letter == " " else letter.upper())


def list_is_open() -> bool:
    return bool(imgui.is_popup_open("", imgui.PopupFlags_.any_popup.value))


@pytest.fixture
def hand() -> Iterator[Rig]:
    view = first_view(bear(), 0.5, 0.5)
    names = ("arm", "red hat", "red jacket", "shoes")
    regions = tuple(NamedRegion(name, Path(f"{name}.region.npy"), b"", 0) for name in names)
    with rig(replace(view, selection=replace(view.selection, regions=regions)), WINDOW) as opened:
        yield opened


@pytest.fixture
def form(hand: Rig) -> Rig:
    """Return the rig with the new-edit form open."""
    strike(hand, "Ctrl+N")
    return hand


def test_opened_form_takes_typed_text_and_ctrl_enter_starts_training(form: Rig) -> None:
    before = form.main_view.work.view
    type_text(form, "red jacket")
    assert form.main_view.work.form.name == "red jacket"
    assert form.main_view.work.view == before, "no letter was a shortcut"
    strike(form, "Enter")
    work = form.main_view.work
    assert (work.form.name, work.form_open, work.renaming) == ("red jacket", True, None)
    assert form.main_view.take_requests() == (), "Enter only commits the name"
    strike(form, "Ctrl+Enter")
    assert form.main_view.take_requests() == (Plain("train"),)


def test_ctrl_enter_trains_after_a_click_on_the_picture(form: Rig) -> None:
    form.click(300.0, 300.0)
    strike(form, "Ctrl+Enter")
    assert form.main_view.take_requests() == (Plain("train"),)


def test_escape_closes_the_form_without_its_name(form: Rig) -> None:
    focus = form.main_view.work.focus
    type_text(form, "hat")
    strike(form, "Escape")
    work = form.main_view.work
    assert (work.form_open, work.form.name, work.focus) == (False, "", focus)
    strike(form, "H")
    assert not form.main_view.work.view.layers[1].enabled, "shortcuts are back"


def test_tab_moves_through_the_form_and_ctrl_enter_always_trains(form: Rig) -> None:
    seen = []
    for _ in range(30):
        seen.append(imgui.get_current_context().nav_id)
        strike(form, "Tab")
    assert len(set(seen)) >= 9, "lists, fields, buttons and sliders"
    assert form.main_view.work.active_slider == "strength"
    strike(form, "Shift+Tab")
    assert imgui.get_current_context().nav_id in seen
    strike(form, "Ctrl+Enter")
    assert form.main_view.take_requests() == (Plain("train"),)


def test_slider_focused_by_tab_moves_by_arrows(form: Rig) -> None:
    def strength() -> float:
        return form.main_view.work.form.strength

    for _ in ("draft", "full", "the eye", "the slider"):
        strike(form, "Tab")
    strike(form, "Left")
    assert strength() == 0.99
    assert not form.io.want_text_input
    for chord, now in (("Shift+Left", 0.89), ("Ctrl+Left", 0.88), ("Right", 0.89), ("Shift+Right", 0.99)):
        strike(form, chord)
        assert strength() == pytest.approx(now, abs=1e-6), chord
    strike(form, "Shift+Right")
    assert strength() == 1.0
    before = imgui.get_current_context().nav_id
    strike(form, "Tab")
    assert imgui.get_current_context().nav_id != before
    assert not imgui.is_any_item_active() or form.io.want_text_input


def test_shift_tab_within_one_slow_frame_moves_backwards(form: Rig) -> None:
    window = Window(cast(Splash, SimpleNamespace(handle=None, context=None)))

    def event(key: int, token: imgui.Key, down: bool) -> None:
        window._note_key(key, 0, glfw.PRESS if down else glfw.RELEASE, 0)
        form.io.add_key_event(token, down)

    strike(form, "Tab")
    before = imgui.get_current_context().nav_id
    strike(form, "Tab")
    event(glfw.KEY_LEFT_SHIFT, imgui.Key.mod_shift, True)
    form.frame()
    event(glfw.KEY_TAB, imgui.Key.tab, True)
    event(glfw.KEY_LEFT_SHIFT, imgui.Key.mod_shift, False)
    event(glfw.KEY_TAB, imgui.Key.tab, False)
    form.frame(5)
    assert imgui.get_current_context().nav_id == before
    assert not form.io.key_shift


def test_list_takes_arrows_and_enter(form: Rig) -> None:
    form.click(*LIST)
    assert list_is_open()
    before = form.main_view.work.view
    for chord in ("Up", "Up", "Enter"):
        strike(form, chord)
    assert not list_is_open()
    assert form.main_view.work.form.region == "red jacket"
    assert form.main_view.work.form_open
    assert form.main_view.take_requests() == ()
    assert form.main_view.work.view == before


def test_letters_jump_in_an_open_list(form: Rig) -> None:
    form.click(*LIST)
    before = form.main_view.work.view
    type_text(form, "r")  # from the whole scene to the red hat
    type_text(form, "r")
    strike(form, "Enter")
    assert form.main_view.work.form.region == "red jacket"
    form.click(*LIST)
    type_text(form, "ws")  # the whole scene, then the shoes
    strike(form, "Enter")
    assert form.main_view.work.form.region == "shoes"
    assert form.main_view.work.view == before, "no letter is a shortcut"


def test_jump_goes_on_after_the_last_title() -> None:
    titles = ("arm", "Red hat", "red jacket", "shoes")
    assert jump_to("r", titles, -1) == 1
    assert jump_to("R", titles, 1) == 2
    assert jump_to("r", titles, 2) == 1
    assert jump_to("ra", titles, 2) == 0
    assert jump_to("x", titles, 0) is None
    assert jump_to("", titles, 0) is None


def test_escape_closes_only_the_list(form: Rig) -> None:
    work = form.main_view.work
    form.click(*LIST)
    strike(form, "Down")
    strike(form, "Escape")
    assert not list_is_open()
    after = form.main_view.work
    assert (after.form_open, after.form.region, after.focus) == (True, work.form.region, work.focus)
    strike(form, "Escape")
    assert not form.main_view.work.form_open


@pytest.mark.slow
@pytest.mark.parametrize("what", ["menu", "list", "question", "form"])
def test_no_shortcut_acts_while_a_menu_or_form_is_open(hand: Rig, what: str) -> None:
    if what in ("list", "form"):
        strike(hand, "Ctrl+N")
    if what == "list":
        hand.click(*LIST)
    if what == "menu":
        hand.click(*hand.at(panel.MENU_ID))
    if what == "question":
        hand.main_view.messages.ask(Dialog("about", "1.0"))
        hand.frame(2)
    left_alone = ("Escape", "Enter", "Tab", "Shift+Tab", "Up", "Down", "Left", "Right", "Space", "Shift+F2")
    for chord in KEYS:
        if chord in left_alone or chord.endswith(("Up", "Down", "Left", "Right")):
            continue
        before = hand.main_view.work
        hand.main_view.wake()
        hand.frame(keys=Keys((Press(chord),), frozenset({chord}), frozenset("WASD")))
        after = hand.main_view.work
        assert (after.view, after.requests, after.dialog, after.help, after.form_open) == (
            before.view,
            before.requests,
            before.dialog,
            before.help,
            before.form_open,
        ), chord


def test_arrows_open_and_close_submenus(hand: Rig) -> None:
    hand.move(WINDOW[0] - 200.0, HEAD)  # a layer's card
    hand.press(1)
    hand.release(1)
    assert imgui.is_popup_open("", imgui.PopupFlags_.any_popup.value)
    depth = len(imgui.get_current_context().open_popup_stack)
    for _ in range(20):
        strike(hand, "Down")
        if imgui.get_current_context().nav_id == 0:
            continue
        strike(hand, "Right")
        if len(imgui.get_current_context().open_popup_stack) > depth:
            break
    assert len(imgui.get_current_context().open_popup_stack) == depth + 1, "a list of the menu"
    strike(hand, "Escape")
    assert len(imgui.get_current_context().open_popup_stack) == depth
    strike(hand, "Escape")
    assert not list_is_open()
    assert hand.main_view.work.focus is not None


def test_escape_and_enter_in_a_list_keep_the_question_open(hand: Rig) -> None:
    options = DeliverOptions(moves="scarf", can_move=("timeline", "scarf", "ears"))
    hand.main_view.messages.ask(Dialog("render_film", "film.mp4", options=options))
    hand.frame(4)
    dialog = next(w for w in imgui.get_current_context().windows if w.name == "##dialog")
    place = dialog.pos.x + 300.0, dialog.pos.y + 167.0
    hand.click(*place)
    assert len(imgui.get_current_context().open_popup_stack) == 2
    strike(hand, "Down")
    strike(hand, "Enter")
    assert (question(hand).moves, hand.main_view.take_requests()) == ("ears", ())
    hand.click(*place)
    strike(hand, "Escape")
    assert question(hand).moves == "ears"
    strike(hand, "Escape")
    assert hand.main_view.work.dialog is None


def question(hand: Rig) -> DeliverOptions:
    assert hand.main_view.work.dialog is not None
    assert hand.main_view.work.dialog.options is not None
    return hand.main_view.work.dialog.options


def test_keyboard_focus_alone_opens_no_tooltip(hand: Rig) -> None:
    hand.move(300.0, 300.0)
    strike(hand, "Ctrl+N")
    for _ in range(4):
        strike(hand, "Tab")
        hand.rest()
        tooltip = imgui.internal.find_window_by_name("##Tooltip_00")
        assert tooltip is None or not tooltip.active
