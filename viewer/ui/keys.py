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


def _keys(
    help_: str, *chords: str, listed: str = "", repeats: bool = False, tap: bool = False
) -> tuple[KeyBinding, ...]:
    """A row of the list of shortcuts, and its keys, each as "chord action"."""
    pairs = [text.split() for text in chords]
    keys = [KeyBinding(chord, action, "", repeats, tap) for chord, action in pairs]
    return replace(keys[0], help=help_, listed=listed), *keys[1:]


_FOCUS = [f"{i} focus:{i}" for i in range(1, 10)] + [f"Shift+{i} toggle:{i}" for i in range(1, 10)]
_NUDGE = [
    f"{modifiers}{arrow} nudge:{sign * step:g}"
    for modifiers, step in NUDGES
    for arrow, sign in (("Left", -1), ("Right", 1), ("Down", -1), ("Up", 1))
]

TOPICS: dict[str, tuple[KeyBinding, ...]] = {
    "Layers": (
        *_keys("select a layer; with Shift show or hide", *_FOCUS, listed="1–9"),
        *_keys("strength or gain; Shift coarse, Ctrl fine", *_NUDGE, listed="← →", repeats=True),
        *_keys("next slider for the arrow keys", "Tab next_slider:1", "Shift+Tab next_slider:-1"),
        *_keys("show or hide the selected layer", "H hide"),
        *_keys("solo (Alt+click the eye)", "Shift+H solo"),
        *_keys("show all", "Alt+H show_all"),
        *_keys("lock", "Shift+L lock"),
        *_keys("gains and curve; with Alt compact rows", "G fold", "Alt+G cards"),
        *_keys("rename (double-click the name)", "Enter rename"),
        *_keys("duplicate", "Ctrl+D duplicate"),
        *_keys("delete", "Ctrl+Delete remove"),
        *_keys("move up or down (drag the name)", "Alt+Up move:-1", "Alt+Down move:1", listed="Alt+↑ ↓"),
        *_keys("select all (Ctrl+click, Shift+click)", "Ctrl+Alt+A select_layers"),
        *_keys("group; with Shift ungroup", "Ctrl+G group", "Ctrl+Shift+G ungroup"),
        *_keys(
            "copy, paste, reset strength and gains",
            *("Ctrl+C copy_values", "Ctrl+V paste_values", "Ctrl+R reset", "Ctrl+Shift+R reset_all"),
            listed="Ctrl+C, V, R",
        ),
        *_keys("search layers", "Ctrl+F search"),
    ),
    "View": (
        *_keys("orbit or fly mode", "V fly"),
        *_keys("frame the selection, layer or scene", "F frame", "Num. frame"),
        *_keys("reset the view (numpad 0)", "Shift+F home", "Num0 home"),
        *_keys(
            "front, right, top; Ctrl opposite",
            *("Num1 look:front", "Num3 look:right", "Num7 look:top"),
            *("Ctrl+Num1 look:back", "Ctrl+Num3 look:left", "Ctrl+Num7 look:bottom"),
            listed="Numpad 1 3 7",
        ),
        *_keys("grid on the ground", "Shift+G grid"),
        *_keys("original: tap, or hold", f"{HELD_ORIGINAL} before", tap=True),
        *_keys("side by side; with Shift split view", "Y beside", "Shift+Y split"),
        *_keys("difference (a tap; held it flies)", "D difference", tap=True),
        *_keys("compare with the recording", "Alt+Y against"),
    ),
    "Edits": (
        *_keys("next blend rule", "M blend"),
        *_keys("overshoot to 1.2", "O overshoot"),
        *_keys("close this list; leave the tool; deselect", "Escape unfocus", listed="Esc"),
        *_keys("undo", "Ctrl+Z undo", repeats=True),
        *_keys("redo", "Ctrl+Shift+Z redo", "Ctrl+Y redo", repeats=True),
    ),
    "Brush": (
        *_keys("paint strength (left drag)", "B brush"),
        *_keys("brush: erase, smooth, add", "X brush_mode"),
        *_keys("brush: front surface or all depths", "Shift+B brush_through"),
        *_keys("brush: tint or all weights as colors", "C brush_weights"),
        *_keys(
            "brush radius; with Shift softness",
            *(f"[ brush_radius:{1 / 1.25:g}", "] brush_radius:1.25"),
            *("Shift+[ brush_softness:-0.1", "Shift+] brush_softness:0.1"),
            listed="[ ]",
            repeats=True,
        ),
        *_keys("clear the paint; with Shift fill it", "Backspace paint_clear", "Shift+Backspace paint_fill"),
        *_keys("feather the paint", "Shift+X paint_feather"),
    ),
    "Select": (
        *_keys(
            "box, lasso, polygon, brush",
            *("R select_tool:box", "L select_tool:lasso", "P select_tool:polygon", "U select_tool:brush"),
            listed="R L P U",
        ),
        *_keys(
            "scribble, sphere, connected and alike, alike",
            *("Shift+U select_tool:scribble", "Shift+R select_tool:sphere"),
            *("J select_tool:flood", "I select_tool:color"),
            listed="Shift+U R J I",
        ),
        *_keys("front surface or all depths", "N select_through"),
        *_keys(
            "all, with Shift none; invert (paint too)",
            *("Ctrl+A select_all", "Ctrl+Shift+A select_none", "Ctrl+I invert"),
            listed="Ctrl+A, I",
        ),
        *_keys("shrink, grow", "Ctrl+[ select_shrink", "Ctrl+] select_grow", listed="Ctrl+[ ]", repeats=True),
        *_keys("hide; with Shift isolate", "Ctrl+H hide_selected", "Ctrl+Shift+H isolate"),
        *_keys(
            "remove, move, copy: as a layer",
            *("Alt+Delete remove_selected", "Alt+M move_selected", "Alt+D duplicate_selected"),
            listed="Alt+Del M D",
        ),
    ),
    "Timeline": (
        *_keys("play or pause", "Space play"),
        *_keys("insert a keyframe", "K key"),
        *_keys("delete the keyframe", "Delete drop_key"),
        *_keys("previous or next frame", ", step:-1", ". step:1", listed=", .", repeats=True),
        *_keys("previous or next keyframe", "Shift+, jump:-1", "Shift+. jump:1", listed="Shift+, ."),
        *_keys("interpolation: smooth, linear, hold", "Shift+K easing"),
        *_keys("ping-pong", "Alt+K ping_pong"),
        *_keys("save the timeline as a file", "Ctrl+K timeline_file"),
        *_keys("show or hide the timeline", "T timeline"),
        *_keys("safe frame: 16:9, square, 9:16, none", "Shift+T safe_frame"),
    ),
    "Window and files": (
        *_keys("this list", "F1 help"),
        *_keys("save the picture as PNG", "F2 picture"),
        *_keys("take this view without edits, to change it", "Ctrl+F2 take_view"),
        *_keys("save the whole window as PNG", "Shift+F2 window_picture"),
        *_keys("add a snapshot; with Shift compare two", "F3 snapshot", "Shift+F3 compare_snapshots"),
        *_keys("save this view as a camera", "F4 camera"),
        *_keys("new edit", "Ctrl+N new_edit"),
        *_keys("save the session", "Ctrl+S save"),
        *_keys("save the session as", "Ctrl+Shift+S save_as"),
        *_keys("open a session, scene or edit", "Ctrl+O open"),
        *_keys("export the edited scene as .ply", "Ctrl+E export"),
        *_keys("export a web page with its sliders", "Ctrl+Shift+E export_page"),
        *_keys("render a picture", "Ctrl+P render_picture"),
        *_keys("render a film", "Ctrl+Shift+P render_film"),
        *_keys("show timings", "F10 overlay"),
        *_keys("dynamic resolution: auto, on, off", "Shift+F10 dynamic_resolution"),
        *_keys(
            "interface larger, smaller, first size",
            *("Ctrl+= zoom:1.1", "Ctrl+Shift+= zoom:1.1"),
            *("Ctrl+- zoom:0.9091", "Ctrl+0 zoom:0"),
            listed="Ctrl + − 0",
        ),
        *_keys("full screen", "F11 full_screen"),
        *_keys("show or hide the panel", "F12 panel"),
        *_keys("quit", "Ctrl+Q quit"),
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
    "export_page",
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
    undecided = tuple((c, at) for c, at in since.items() if c in keys.held and now - at <= TAP_S)
    return Taps(undecided), [actions[chord] for chord in tapped]


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
        self._opened_at = -OPENING_FRAMES  # the frame in which a text field was last asked for

    @property
    def opening(self) -> bool:
        """Whether a text field was asked for and has no keyboard yet."""
        return self._frames - self._opened_at < OPENING_FRAMES and not imgui.get_io().want_text_input

    def take(self, keys: Keys) -> Keys:
        """The keys of one frame that imgui has come to; call once a frame."""
        pressed = (*self._waiting, *keys.pressed)
        count = 0 if self.opening else sum(1 for _ in itertools.takewhile(has_reached_imgui, pressed))
        opener = next((i for i, press in enumerate(pressed[:count]) if opens_text(press)), None)
        self._frames += 1
        if opener is not None:
            count, self._opened_at = opener + 1, self._frames
        self._waiting = pressed[count:]
        return replace(keys, pressed=pressed[:count])
