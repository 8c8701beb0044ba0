"""User input in the words of `controls`: which actions keys ask for, which drag has begun."""

from __future__ import annotations

from dataclasses import dataclass, replace

from imgui_bundle import imgui

from . import controls
from .view_camera import ViewCamera

_BUTTONS = (("left", 0), ("right", 1), ("middle", 2))


@dataclass(frozen=True)
class Press:
    """A key that went down, with the modifiers that were held just then.

    Args:
        chord: as in `controls.KEYS`
        again: it went down before and is held
        event_id: its place among imgui's input events (see `has_reached_imgui`); −1 is before all
    """

    chord: str
    again: bool = False
    event_id: int = -1


@dataclass(frozen=True)
class Keys:
    """What the keyboard did since the last frame.

    Not taken from imgui: it merges the events of a slow frame, and the Ctrl of a quick Ctrl+Z would be lost.

    Args:
        pressed: in their order
        held: names of the keys that are down, as in the chords of `controls.KEYS`
        fly: which of `controls.FLY_KEYS` are down, by their physical place
    """

    pressed: tuple[Press, ...] = ()
    held: frozenset[str] = frozenset()
    fly: frozenset[str] = frozenset()


NO_KEYS = Keys()


@dataclass(frozen=True)
class Taps:
    """Keys that are down and may yet have been tapped, and since when."""

    since: tuple[tuple[str, float], ...] = ()

    def without(self, keys: Keys) -> Keys:
        """The keys, of which these do not fly yet."""
        return replace(keys, fly=keys.fly - {chord for chord, _ in self.since})


def has_reached_imgui(press: Press) -> bool:
    """Whether imgui, which takes text and keys in over several frames, has come to this key.

    A key that comes before its time would overtake what was typed before it.
    """
    waiting = imgui.get_current_context().input_events_queue
    return waiting.empty() or waiting[0].event_id > press.event_id


def opens_text(press: Press) -> bool:
    """Whether a key asks for a text field: it needs some frames until it has the keyboard."""
    opens = any(key.chord == press.chord and key.action in controls.OPENS_TEXT for key in controls.KEYS)
    return opens and not imgui.get_io().want_text_input


def has_pending_input() -> bool:
    """Whether imgui still holds input that its next frames take in."""
    return not imgui.get_current_context().input_events_queue.empty()


def next_event_id() -> int:
    """The place that the next event takes among imgui's input events."""
    return int(imgui.get_current_context().input_events_next_event_id)


def requested_actions(keys: Keys) -> list[str]:
    """Actions of `controls.KEYS` that were asked for; none while a text field is open."""
    if imgui.get_io().want_text_input:
        return []
    return [
        key.action
        for press in keys.pressed
        for key in controls.KEYS
        if key.chord == press.chord and not key.tap and (key.repeats or not press.again)
    ]


def tapped_actions(taps: Taps, keys: Keys, now: float, flies: bool) -> tuple[Taps, list[str]]:
    """Actions of keys that were let go soon after they went down; none while a text field is open.

    Args:
        taps: as it was after the last frame
        now: seconds on the main view's clock
        flies: flight keys fly at once, so that none of them is tapped
    """
    if imgui.get_io().want_text_input:
        return Taps(), []
    actions = {key.chord: key.action for key in controls.KEYS if key.tap}
    ignored = controls.FLY_KEYS if flies or len(keys.fly) > 1 else ()
    down = {press.chord: now for press in keys.pressed if press.chord in actions and not press.again}
    since = {chord: at for chord, at in {**dict(taps.since), **down}.items() if chord not in ignored}
    tapped = [c for c, at in since.items() if c not in keys.held and now - at <= controls.TAP_S]
    held = tuple((c, at) for c, at in since.items() if c in keys.held and now - at <= controls.TAP_S)
    return Taps(held), [actions[chord] for chord in tapped]


def is_repeating(keys: Keys) -> bool:
    """Whether a key that repeats is held: what it does is not over yet."""
    return any(key.repeats and key.chord.rpartition("+")[2] in keys.held for key in controls.KEYS)


def holds_original(keys: Keys) -> bool:
    """Whether the key that shows the original is held."""
    return controls.HELD_ORIGINAL in keys.held and not imgui.get_io().want_text_input


def modifier() -> str:
    """The one modifier that decides what a drag does."""
    io = imgui.get_io()
    return "Shift" if io.key_shift else "Ctrl" if io.key_ctrl else "Alt" if io.key_alt else ""


def started_drag(mode: str) -> str | None:
    """What the button that went down over the picture in this frame does, or None."""
    for name, button in _BUTTONS:
        if imgui.is_mouse_clicked(button):
            return controls.drag_for(name, modifier(), mode)
    return None


def any_button_down() -> bool:
    return any(imgui.is_mouse_down(button) for _, button in _BUTTONS)


def cancels_drag(keys: Keys, drag: str | None) -> bool:
    """Whether Escape or the right button takes back what the left button is dragging.

    Args:
        drag: what is held on the picture, see `mouse.MouseTool`; the camera stays where it was turned
    """
    io, buttons = imgui.get_io(), imgui.MouseButton_
    holds = imgui.is_any_item_active() or (drag is not None and all(drag != d.does for d in controls.DRAGS))
    if not holds or io.want_text_input or not imgui.is_mouse_down(buttons.left.value):
        return False
    escape = any(press.chord == "Escape" for press in keys.pressed)
    return escape or bool(imgui.is_mouse_clicked(buttons.right.value))


def is_flying(keys: Keys) -> bool:
    """Whether flight keys are held, and not as parts of a chord or of a text."""
    io = imgui.get_io()
    return bool(keys.fly) and not (io.want_text_input or io.key_ctrl or io.key_super)


def fly(camera: ViewCamera, keys: Keys, seconds: float, radius: float) -> ViewCamera:
    """Flight by the keys that are down."""
    io = imgui.get_io()
    right, up, ahead = (sum(controls.FLY_KEYS[key][i] for key in keys.fly) for i in range(3))
    pace = 10.0 if io.key_shift else 0.1 if io.key_alt else 1.0
    return controls.fly(camera, right, up, ahead, seconds, radius, pace)
