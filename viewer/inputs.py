"""Reads imgui's io: which bound keys were pressed, which drag is under way, where the mouse moved."""

from __future__ import annotations

from functools import cache

from imgui_bundle import imgui

from . import controls
from .state import ViewCamera

_BUTTONS = (("left", 0), ("right", 1), ("middle", 2))
_MODIFIERS = {"Ctrl": imgui.Key.mod_ctrl, "Shift": imgui.Key.mod_shift, "Alt": imgui.Key.mod_alt}


@cache
def key_of(chord: str) -> tuple[imgui.Key, int]:
    """imgui's key and modifier mask of a chord such as "Ctrl+Shift+Z" or "F10".

    Raises:
        AttributeError: there is no such key.
    """
    *held, name = chord.split("+")
    mask = 0
    for modifier in held:
        mask |= int(_MODIFIERS[modifier])
    arrows = {"Left": "left_arrow", "Right": "right_arrow", "Up": "up_arrow", "Down": "down_arrow"}
    attribute = f"_{name}" if name.isdigit() else arrows.get(name, name.lower())
    return getattr(imgui.Key, attribute), mask


def actions_pressed() -> list[str]:
    """Actions of `controls.KEYS` whose keys were pressed, or repeat; none while a text field is open."""
    io = imgui.get_io()
    if io.want_text_input:
        return []
    mask = int(io.key_mods)
    bound = ((key, *key_of(key.chord)) for key in controls.KEYS)
    return [
        key.action for key, code, mods in bound if mods == mask and imgui.is_key_pressed(code, key.repeats)
    ]


def repeating() -> bool:
    """Whether a key that repeats is held: the gesture is not over, and frames must go on."""
    return any(imgui.is_key_down(key_of(key.chord)[0]) for key in controls.KEYS if key.repeats)


def holds_original() -> bool:
    """Whether the key that shows the original is held."""
    return not imgui.get_io().want_text_input and imgui.is_key_down(imgui.Key.backslash)


def modifier() -> str:
    """The one modifier that decides what a drag does."""
    io = imgui.get_io()
    return "Shift" if io.key_shift else "Ctrl" if io.key_ctrl else "Alt" if io.key_alt else ""


def drag_begun(mode: str) -> str | None:
    """What the button that went down over the picture in this frame does, or None."""
    for name, button in _BUTTONS:
        if imgui.is_mouse_clicked(button):
            return controls.drag_for(name, modifier(), mode)
    return None


def any_button_down() -> bool:
    return any(imgui.is_mouse_down(button) for _, button in _BUTTONS)


def fly(camera: ViewCamera, keys: frozenset[str], seconds: float, radius: float) -> ViewCamera:
    """Flight by the keys that are down (names of `controls.FLY_KEYS`)."""
    io = imgui.get_io()
    right, up, ahead = (sum(controls.FLY_KEYS[key][i] for key in keys) for i in range(3))
    pace = 10.0 if io.key_shift else 0.1 if io.key_alt else 1.0
    return controls.fly(camera, right, up, ahead, seconds, radius, pace)
