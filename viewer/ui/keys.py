"""The one table of keys and drags, and what the person does with them, as actions of the table.

The list of shortcuts, menus and tips name keys by `shortcut`.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

from imgui_bundle import imgui

from viewer.camera import controls
from viewer.camera.view_camera import ViewCamera


@dataclass(frozen=True)
class DragBinding:
    """A mouse drag on the picture. `mode`: only in this camera mode; empty is both."""

    button: str
    modifier: str
    does: str
    mode: str = ""


@dataclass(frozen=True)
class KeyBinding:
    """A key: modifiers in the order Ctrl, Shift, Alt, then the key's name."""

    chord: str
    action: str
    help: str  # in the list of shortcuts; "" where another row says it
    repeats: bool = False  # while held
    tap: bool = False  # done when the key is let go soon, as held it does something else
    listed: str = ""  # chords in the list of shortcuts, where the row is about several


DRAGS = (
    DragBinding("left", "", "orbit"),
    DragBinding("left", "Alt", "orbit"),
    DragBinding("middle", "", "orbit"),
    DragBinding("middle", "Shift", "pan"),
    DragBinding("middle", "Ctrl", "dolly"),
    DragBinding("right", "", "look", mode="fly"),
    DragBinding("right", "", "pan"),
)

FLY_KEYS = {"W": (0, 0, 1), "S": (0, 0, -1), "A": (-1, 0, 0), "D": (1, 0, 0), "Q": (0, -1, 0), "E": (0, 1, 0)}
"""Physical keys (their places on a US keyboard) → right, up, ahead."""

HELD_ORIGINAL = "\\"
TAP_S = 0.25
"""A key that is let go sooner was tapped, not held."""
NUDGES = (("", 0.01), ("Shift+", 0.10), ("Ctrl+", 0.001))

TOPICS: dict[str, tuple[KeyBinding, ...]] = {
    "Layers": (
        *(
            KeyBinding(
                str(i),
                f"focus:{i}",
                "select a layer; with Shift show or hide" if i == 1 else "",
                listed="1–9",
            )
            for i in range(1, 10)
        ),
        *(KeyBinding(f"Shift+{i}", f"toggle:{i}", "") for i in range(1, 10)),
        *(
            KeyBinding(f"{held}{arrow}", f"nudge:{sign * step:g}", help_, repeats=True, listed="← →")
            for held, step in NUDGES
            for arrow, sign, help_ in (
                ("Left", -1, ""),
                ("Right", 1, "strength or gain; Shift coarse, Ctrl fine" if not held else ""),
                ("Down", -1, ""),
                ("Up", 1, ""),
            )
        ),
        KeyBinding("Tab", "next_slider:1", "next slider for the arrow keys"),
        KeyBinding("Shift+Tab", "next_slider:-1", ""),
        KeyBinding("H", "hide", "show or hide the selected layer"),
        KeyBinding("Shift+H", "solo", "solo (Alt+click the eye)"),
        KeyBinding("Alt+H", "show_all", "show all"),
        KeyBinding("Shift+L", "lock", "lock"),
        KeyBinding("G", "fold", "gains and curve; with Alt compact rows"),
        KeyBinding("Enter", "rename", "rename (double-click the name)"),
        KeyBinding("Ctrl+D", "duplicate", "duplicate"),
        KeyBinding("Ctrl+Delete", "remove", "delete"),
        KeyBinding("Alt+Up", "move:-1", ""),
        KeyBinding("Alt+Down", "move:1", "move up or down (drag the name)", listed="Alt+↑ ↓"),
        KeyBinding("Ctrl+Alt+A", "select_layers", "select all (Ctrl+click, Shift+click)"),
        KeyBinding("Ctrl+G", "group", "group; with Shift ungroup"),
        KeyBinding("Ctrl+Shift+G", "ungroup", ""),
        KeyBinding("Ctrl+C", "copy_values", "copy, paste, reset strength and gains", listed="Ctrl+C, V, R"),
        KeyBinding("Ctrl+V", "paste_values", ""),
        KeyBinding("Ctrl+R", "reset", ""),
        KeyBinding("Ctrl+Shift+R", "reset_all", ""),
        KeyBinding("Ctrl+F", "search", "search layers"),
        KeyBinding("Alt+G", "cards", ""),
    ),
    "View": (
        KeyBinding("V", "fly", "orbit or fly mode"),
        KeyBinding("F", "frame", "frame the selection, layer or scene"),
        KeyBinding("Num.", "frame", ""),
        KeyBinding("Shift+F", "home", "reset the view (numpad 0)"),
        KeyBinding("Num0", "home", ""),
        KeyBinding("Num1", "look:front", "front, right, top; Ctrl opposite", listed="Numpad 1 3 7"),
        KeyBinding("Num3", "look:right", ""),
        KeyBinding("Num7", "look:top", ""),
        KeyBinding("Ctrl+Num1", "look:back", ""),
        KeyBinding("Ctrl+Num3", "look:left", ""),
        KeyBinding("Ctrl+Num7", "look:bottom", ""),
        KeyBinding("Shift+G", "grid", "grid on the ground"),
        KeyBinding(HELD_ORIGINAL, "before", "original: tap, or hold", tap=True),
        KeyBinding("Y", "beside", "side by side; with Shift split view"),
        KeyBinding("Shift+Y", "split", ""),
        KeyBinding("D", "difference", "difference (a tap; held it flies)", tap=True),
        KeyBinding("Alt+Y", "against", "compare with the recording"),
    ),
    "Edits": (
        KeyBinding("M", "blend", "next blend rule"),
        KeyBinding("O", "overshoot", "overshoot to 1.2"),
        KeyBinding("Escape", "unfocus", "close this list; leave the tool; deselect", listed="Esc"),
        KeyBinding("Ctrl+Z", "undo", "undo", repeats=True),
        KeyBinding("Ctrl+Shift+Z", "redo", "redo", repeats=True),
        KeyBinding("Ctrl+Y", "redo", "", repeats=True),
    ),
    "Brush": (
        KeyBinding("B", "brush", "paint strength (left drag)"),
        KeyBinding("X", "brush_mode", "brush: erase, smooth, add"),
        KeyBinding("Shift+B", "brush_through", "brush: front surface or all depths"),
        KeyBinding("C", "brush_weights", "brush: tint or all weights as colors"),
        KeyBinding("[", f"brush_radius:{1 / 1.25:g}", "", repeats=True),
        KeyBinding("]", "brush_radius:1.25", "brush radius; with Shift softness", repeats=True, listed="[ ]"),
        KeyBinding("Shift+[", "brush_softness:-0.1", "", repeats=True),
        KeyBinding("Shift+]", "brush_softness:0.1", "", repeats=True),
        KeyBinding("Backspace", "paint_clear", "clear the paint; with Shift fill it"),
        KeyBinding("Shift+Backspace", "paint_fill", ""),
        KeyBinding("Shift+X", "paint_feather", "feather the paint"),
    ),
    "Select": (
        KeyBinding("R", "select_tool:box", "box, lasso, polygon, brush", listed="R L P U"),
        KeyBinding("L", "select_tool:lasso", ""),
        KeyBinding("P", "select_tool:polygon", ""),
        KeyBinding("U", "select_tool:brush", ""),
        KeyBinding("Shift+R", "select_tool:sphere", ""),
        KeyBinding("J", "select_tool:flood", "sphere, connected and alike, alike", listed="Shift+R J I"),
        KeyBinding("I", "select_tool:color", ""),
        KeyBinding("N", "select_through", "front surface or all depths"),
        KeyBinding("Ctrl+A", "select_all", "all; with Shift none"),
        KeyBinding("Ctrl+Shift+A", "select_none", ""),
        KeyBinding("Ctrl+I", "invert", "invert, or the paint with the brush"),
        KeyBinding("Ctrl+[", "select_shrink", "", repeats=True),
        KeyBinding("Ctrl+]", "select_grow", "shrink, grow", repeats=True, listed="Ctrl+[ ]"),
        KeyBinding("Ctrl+H", "hide_selected", "hide; with Shift isolate"),
        KeyBinding("Ctrl+Shift+H", "isolate", ""),
    ),
    "Timeline": (
        KeyBinding("Space", "play", "play or pause"),
        KeyBinding("K", "key", "insert a keyframe"),
        KeyBinding("Delete", "drop_key", "delete the keyframe"),
        KeyBinding(",", "step:-1", "", repeats=True),
        KeyBinding(".", "step:1", "previous or next frame", repeats=True, listed=", ."),
        KeyBinding("Shift+,", "jump:-1", ""),
        KeyBinding("Shift+.", "jump:1", "previous or next keyframe", listed="Shift+, ."),
        KeyBinding("Shift+K", "easing", "interpolation: smooth, linear, hold"),
        KeyBinding("Alt+K", "ping_pong", "ping-pong"),
        KeyBinding("Ctrl+K", "timeline_file", "save the timeline as a file"),
        KeyBinding("T", "timeline", "show or hide the timeline"),
    ),
    "Window and files": (
        KeyBinding("F1", "help", "this list"),
        KeyBinding("F2", "picture", "save the picture as PNG"),
        KeyBinding("Ctrl+F2", "take_view", "take this view without edits, to change it"),
        KeyBinding("Shift+F2", "window_picture", "save the whole window as PNG"),
        KeyBinding("F3", "snapshot", "add a snapshot; with Shift compare two"),
        KeyBinding("Shift+F3", "compare_snapshots", ""),
        KeyBinding("F4", "camera", "save this view as a camera"),
        KeyBinding("Ctrl+N", "new_edit", "new edit"),
        KeyBinding("Ctrl+S", "save", "save the session"),
        KeyBinding("Ctrl+Shift+S", "save_as", "save the session as"),
        KeyBinding("Ctrl+O", "open", "open a session, scene or edit"),
        KeyBinding("Ctrl+E", "export", "export the edited scene as .ply"),
        KeyBinding("Ctrl+P", "render_picture", "render a picture"),
        KeyBinding("Ctrl+Shift+P", "render_film", "render a film"),
        KeyBinding("F10", "overlay", "show timings"),
        KeyBinding("Shift+F10", "dynamic_resolution", "dynamic resolution: auto, on, off"),
        KeyBinding("F11", "full_screen", "full screen"),
        KeyBinding("F12", "panel", "show or hide the panel"),
        KeyBinding("Ctrl+Q", "quit", "quit"),
    ),
}
KEYS = tuple(key for keys in TOPICS.values() for key in keys)

OPENS_TEXT = (
    "rename",
    "search",
    "new_edit",
    "save",
    "save_as",
    "open",
    "export",
    "render_picture",
    "render_film",
)
"""Actions after which one types."""


def shortcut(action: str) -> str:
    """The chord of an action, in a person's words; "" where there is none."""
    chord = next((key.chord for key in KEYS if key.action == action), "")
    return chord.replace("Delete", "Del").replace("Num", "Numpad ")


def drag_for(button: str, modifier: str, mode: str) -> str | None:
    """What a drag does, or None where nothing is bound. `modifier`: "", "Shift", "Ctrl" or "Alt"."""
    for drag in DRAGS:
        if drag.button == button and drag.modifier == modifier and drag.mode in ("", mode):
            return drag.does
    return None


_BUTTONS = (("left", 0), ("right", 1), ("middle", 2))


@dataclass(frozen=True)
class Press:
    """A key that went down, with the modifiers that were held just then."""

    chord: str  # as in `KEYS`
    again: bool = False  # it went down before and is held
    event_id: int = -1  # its place among imgui's input events (see `has_reached_imgui`); −1 is before all


@dataclass(frozen=True)
class Keys:
    """What the keyboard did since the last frame.

    Not taken from imgui: it merges the events of a slow frame, and the Ctrl of a quick Ctrl+Z would be lost.
    """

    pressed: tuple[Press, ...] = ()  # in their order
    held: frozenset[str] = frozenset()  # names of the keys that are down, as in the chords of `KEYS`
    fly: frozenset[str] = frozenset()  # which of `FLY_KEYS` are down, by their physical place


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
    opens = any(key.chord == press.chord and key.action in OPENS_TEXT for key in KEYS)
    return opens and not imgui.get_io().want_text_input


def has_pending_input() -> bool:
    """Whether imgui still holds input that its next frames take in."""
    return not imgui.get_current_context().input_events_queue.empty()


def next_event_id() -> int:
    """The place that the next event takes among imgui's input events."""
    return int(imgui.get_current_context().input_events_next_event_id)


def requested_actions(keys: Keys) -> list[str]:
    """Actions of `KEYS` that were asked for; none while a text field is open."""
    if imgui.get_io().want_text_input:
        return []
    return [
        key.action
        for press in keys.pressed
        for key in KEYS
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
    actions = {key.chord: key.action for key in KEYS if key.tap}
    ignored = FLY_KEYS if flies or len(keys.fly) > 1 else ()
    down = {press.chord: now for press in keys.pressed if press.chord in actions and not press.again}
    since = {chord: at for chord, at in {**dict(taps.since), **down}.items() if chord not in ignored}
    tapped = [c for c, at in since.items() if c not in keys.held and now - at <= TAP_S]
    held = tuple((c, at) for c, at in since.items() if c in keys.held and now - at <= TAP_S)
    return Taps(held), [actions[chord] for chord in tapped]


def is_repeating(keys: Keys) -> bool:
    """Whether a key that repeats is held: what it does is not over yet."""
    return any(key.repeats and key.chord.rpartition("+")[2] in keys.held for key in KEYS)


def holds_original(keys: Keys) -> bool:
    """Whether the key that shows the original is held."""
    return HELD_ORIGINAL in keys.held and not imgui.get_io().want_text_input


def modifier() -> str:
    """The one modifier that decides what a drag does."""
    io = imgui.get_io()
    return "Shift" if io.key_shift else "Ctrl" if io.key_ctrl else "Alt" if io.key_alt else ""


def started_drag(mode: str) -> str | None:
    """What the button that went down over the picture in this frame does, or None."""
    for name, button in _BUTTONS:
        if imgui.is_mouse_clicked(button):
            return drag_for(name, modifier(), mode)
    return None


def any_button_down() -> bool:
    return any(imgui.is_mouse_down(button) for _, button in _BUTTONS)


def cancels_drag(keys: Keys, drag: str | None) -> bool:
    """Whether Escape or the right button takes back what the left button is dragging.

    Args:
        drag: what is held on the picture, see `mouse.MouseTool`; the camera stays where it was turned
    """
    io, buttons = imgui.get_io(), imgui.MouseButton_
    holds = imgui.is_any_item_active() or (drag is not None and all(drag != d.does for d in DRAGS))
    if not holds or io.want_text_input or not imgui.is_mouse_down(buttons.left.value):
        return False
    escape = any(press.chord == "Escape" for press in keys.pressed)
    return escape or bool(imgui.is_mouse_clicked(buttons.right.value))


def is_flying(keys: Keys) -> bool:
    """Whether flight keys are held, and not as parts of a chord or of a text."""
    io = imgui.get_io()
    return bool(keys.fly) and not (io.want_text_input or io.key_ctrl or io.key_super)


def fly_by_keys(camera: ViewCamera, keys: Keys, seconds: float, radius: float) -> ViewCamera:
    """Flight by the keys that are down."""
    io = imgui.get_io()
    right, up, ahead = (sum(FLY_KEYS[key][i] for key in keys.fly) for i in range(3))
    pace = 10.0 if io.key_shift else 0.1 if io.key_alt else 1.0
    return controls.fly(camera, right, up, ahead, seconds, radius, pace)


OPENING_FRAMES = 4
"""From the wish for a text field until imgui gives it the keyboard."""


class PendingKeys:
    """Hands keys on in step with imgui; while a text field opens they wait for it."""

    def __init__(self) -> None:
        self._waiting: tuple[Press, ...] = ()
        self._frames = 0
        self._asked_at = -OPENING_FRAMES  # the frame in which a text field was last asked for

    @property
    def opening(self) -> bool:
        """Whether a text field was asked for and has no keyboard yet."""
        return self._frames - self._asked_at < OPENING_FRAMES and not imgui.get_io().want_text_input

    def take(self, keys: Keys) -> Keys:
        """The keys of one frame that imgui has come to; call once a frame."""
        pressed = (*self._waiting, *keys.pressed)
        count = 0 if self.opening else sum(1 for _ in itertools.takewhile(has_reached_imgui, pressed))
        opener = next((i for i, press in enumerate(pressed[:count]) if opens_text(press)), None)
        self._frames += 1
        if opener is not None:
            count, self._asked_at = opener + 1, self._frames
        self._waiting = pressed[count:]
        return replace(keys, pressed=pressed[:count])
