"""The one table of commands with their keys, and of drags; what the person does, as actions of the table.

Menus, tips, the list of keys and that of all commands are made from it.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from imgui_bundle import imgui

from viewer.camera import controls
from viewer.camera.view_camera import ViewCamera


@dataclass(frozen=True)
class Command:
    """An action of `actions.perform` as a person meets it: in menus, tips, lists and, some day, speech."""

    action: str
    name: str  # what it is called everywhere, also by who cannot see its icon
    keys: str = ""  # chords with blanks between: modifiers in the order Ctrl, Shift, Alt, then the key's name
    help: str = ""  # what a tip says beside the name
    repeats: bool = False  # while a key is held
    types: bool = False  # one types afterwards
    row: str = ""  # in the list of keys, where it is about several commands; `JOINED` for the others of them
    listed: str = ""  # its keys there, where they are too many
    in_hand: bool = False  # of a tool or a decal in the hand, which then has these keys before others


DRAGS = {
    "left": "orbit",
    "Alt+left": "orbit",
    "middle": "orbit",
    "Shift+middle": "pan",
    "Ctrl+middle": "dolly",
    "right": "pan",
}
"""What a mouse drag on the picture does; in fly, the bare right one looks around."""


FLY_KEYS = {"W": (0, 0, 1), "S": (0, 0, -1), "A": (-1, 0, 0), "D": (1, 0, 0), "Q": (0, -1, 0), "E": (0, 1, 0)}
"""Physical keys (their places on a US keyboard) → right, up, ahead."""

NUDGES = (("", 0.01), ("Shift+", 0.10), ("Ctrl+", 0.001))


JOINED = "-"
"""The row of a command that the one before it in the table shows too."""


def _row(listed: str, does: str, commands: Iterable[Command]) -> Iterator[Command]:
    """Commands that share a line of the list of keys."""
    return (replace(command, listed=listed, row=does) for command in commands)


def _numbers(action: str, name: str, modifier: str = "") -> Iterator[Command]:
    return (Command(f"{action}:{i}", f"{name} {i}", f"{modifier}{i}") for i in range(1, 10))


def _nudges() -> Iterator[Command]:
    for modifier, step in NUDGES:
        for (arrow, other), sign in ((("Right", "Up"), 1), (("Left", "Down"), -1)):
            keys = f"{modifier}{arrow} {modifier}{other}"
            yield Command(f"nudge:{sign * step:g}", f"Strength {100 * sign * step:+g} %", keys, repeats=True)


def _points() -> Iterator[Command]:
    for modifier, step in (("", 4), ("Shift+", 40)):
        for arrow, x, y in (("Left", -1, 0), ("Right", 1, 0), ("Up", 0, -1), ("Down", 0, 1)):
            name = f"Pointer {arrow.lower()} by {step} px"
            yield Command(f"point:{x * step},{y * step}", name, f"{modifier}{arrow}", in_hand=True)


def _looks() -> Iterator[Command]:
    for key, side, other in (("Num1", "front", "back"), ("Num3", "right", "left"), ("Num7", "top", "bottom")):
        yield Command(f"look:{side}", f"View from the {side}", key)
        yield Command(f"look:{other}", f"View from the {other}", f"Ctrl+{key}")


def _steps(action: str, what: str, modifier: str = "", repeats: bool = False) -> Iterator[Command]:
    yield Command(f"{action}:-1", f"Previous {what}", f"{modifier},", repeats=repeats)
    yield Command(f"{action}:1", f"Next {what}", f"{modifier}.", repeats=repeats)


def _zooms() -> Iterator[Command]:
    yield Command("zoom:1.1", "Larger interface", "Ctrl+= Ctrl+Shift+=")
    yield Command("zoom:0.9091", "Smaller interface", "Ctrl+-")
    yield Command("zoom:0", "Interface as at first", "Ctrl+0")


MODES = "Shift adds, Ctrl subtracts, both intersect"
_CORNERS = f"Click its corners; Enter or a double click closes it. {MODES}"

TOPICS: dict[str, tuple[Command, ...]] = {
    "View": (
        Command("fly", "Orbit or fly", "V"),
        Command("navigate:orbit", "Orbit", "", "Around a pivot"),
        Command("navigate:fly", "Fly", "", "W A S D, Q E; right drag looks around"),
        Command("frame", "Frame", "F Num.", "The selection, the selected layer, or the scene"),
        Command("home", "Reset the view", "Shift+F Num0"),
        *_row("Numpad 1 3 7", "Front, right, top", _looks()),
        Command("grid", "Ground grid", "Shift+G"),
        Command("axes", "Axes"),
        Command("before", "Original", "\\", "Until it is pressed again, or a slider moves"),
        Command("beside", "Side by side", "Y"),
        Command("split", "Split view", "Shift+Y"),
        Command("difference", "Difference", "Alt+Y", "Amplified, with its PSNR"),
    ),
    "Layers": (
        *_row("1–9", "Select a layer", _numbers("focus", "Select layer")),
        *_row("Shift+1–9", "Show or hide a layer", _numbers("toggle", "Show or hide layer", "Shift+")),
        *_row("← →", "Strength, or gain", _nudges()),
        Command("next_slider:1", "Next gain for arrow keys", "Alt+Right", row="Next, previous gain"),
        Command("next_slider:-1", "Previous gain", "Alt+Left", row=JOINED),
        Command("hide", "Show or hide", "H", "Alt+click: solo"),
        Command("solo", "Solo", "Shift+H", "Show only soloed layers"),
        Command("show_all", "Show all", "Alt+H", "All layers, and all that is hidden"),
        Command("lock", "Lock", "Shift+L", "Strength, gains and paint stay as they are"),
        Command("fold", "Details and gains", "G", "What it is, and gains"),
        Command("cards", "Compact rows", "Alt+G"),
        Command("rename", "Rename…", "Enter", types=True),
        Command("duplicate", "Duplicate", "Ctrl+D"),
        Command("replace", "Replace…", "", "Another edit in its place"),
        Command("again", "Again with other settings", "", "The form of a new edit as it was for this one"),
        Command("remove", "Delete", "Ctrl+Delete"),
        Command("limit_to_selection", "Limit to the selection", "", "Paint: nothing of it elsewhere"),
        Command("select_painted", "Select where it shows", "", "Its region, or half of its paint and more"),
        Command("move:-1", "Move up", "Alt+Up", "The top layer lies on top", row="Move up, down"),
        Command("move:1", "Move down", "Alt+Down", row=JOINED),
        Command("select_layers", "Select all layers", "Ctrl+Alt+A"),
        Command("group", "New group", "Ctrl+G", "With a switch and a strength", row="Group; Shift ungroups"),
        Command("ungroup", "Ungroup", "Ctrl+Shift+G", row=JOINED),
        Command("reset", "Reset values", "Ctrl+R", "Strength 0, gains 1", row="Reset values; Shift all"),
        Command("reset_all", "Reset all layers", "Ctrl+Shift+R", row=JOINED),
        Command("search", "Search layers…", "Ctrl+F", types=True),
    ),
    "Edits": (
        Command("blend", "Next blend rule", "M"),
        Command("overshoot", "Overshoot to 1.2", "O", "Sliders extrapolate past what was trained"),
        Command("unfocus", "Leave tool, deselect", "Escape"),
        Command("undo", "Undo", "Ctrl+Z", repeats=True),
        Command("redo", "Redo", "Ctrl+Shift+Z Ctrl+Y", repeats=True),
        Command("copy_keys", "Copy keyframes", "Ctrl+C", "Those chosen", row="Copy, paste keys"),
        Command("paste_keys", "Paste keyframes", "Ctrl+V", "At the playhead", row=JOINED),
        Command("history", "History…", "Ctrl+Alt+Z", "Everything that was done; one goes back to any of it"),
    ),
    "Brush": (
        Command("brush", "Paint strength", "B", "Of the selected layer, by a left drag"),
        Command("brush_mode", "Erase, smooth, add", "X"),
        Command("brush_through", "Front or through", "Shift+B", "The front surface, or all under it"),
        Command("brush_weights", "Weights as colors", "C"),
        Command("brush_radius:0.8", "Smaller", "[", repeats=True, row="Radius, or tolerance"),
        Command("brush_radius:1.25", "Larger", "]", repeats=True, row=JOINED),
        Command("brush_softness:-0.1", "Harder", "Shift+[", repeats=True, row="Harder, softer"),
        Command("brush_softness:0.1", "Softer", "Shift+]", repeats=True, row=JOINED),
        Command("paint_clear", "Clear the paint", "Backspace", "All to 0", row="Clear paint; Shift fills"),
        Command("paint_fill", "Fill with paint", "Shift+Backspace", "All to 1", row=JOINED),
        Command("paint_invert", "Invert the paint", "", "Swap what is painted and what is not"),
        Command("paint_feather", "Feather the paint", "Shift+X", "Soften its edges; repeat for more"),
    ),
    "Select": (
        Command("select_tool:box", "Box", "R", MODES),
        Command("select_tool:lasso", "Lasso", "L", MODES),
        Command("select_tool:polygon", "Polygon", "P", _CORNERS),
        Command("select_tool:brush", "Selection brush", "U", MODES),
        Command("select_tool:scribble", "Scribble", "Shift+U", "Strokes on a thing, and beside it (Ctrl)"),
        Command("select_tool:sphere", "Sphere", "Shift+R", f"Drag from its center on a surface. {MODES}"),
        Command("select_tool:flood", "Connected and alike", "J", f"Click a surface. {MODES}"),
        Command("select_tool:color", "Everything alike", "I", f"Click a color. {MODES}"),
        *_row("← → ↑ ↓", "Tool's pointer; Shift far", _points()),
        Command(
            "point_press",
            "Press, or let go",
            "Space Enter Shift+Space Ctrl+Space Ctrl+Shift+Space",
            "As the mouse button does: corners, clicks, or a drag until it is pressed again",
            row="Tool: press, let go",
            listed="Space Enter",
            in_hand=True,
        ),
        Command("select_through", "Front or through", "N", "The front surface, or what lies behind it too"),
        Command("select_all", "Select everything", "Ctrl+A", row="All; Shift nothing"),
        Command("select_none", "Select nothing", "Ctrl+Shift+A", row=JOINED),
        Command("invert", "Invert", "Ctrl+I", "Select everything else; while painting, the paint"),
        Command("select_shrink", "Shrink", "Ctrl+[", "Less its border", repeats=True, row="Shrink, grow"),
        Command("select_grow", "Grow", "Ctrl+]", "Add the neighbors", repeats=True, row=JOINED),
        Command("select_smooth", "Smooth", "", "Straighten the border, drop strays, fill holes"),
        Command("select_refine", "Refine", "", "Put a rough rim where color and gaps have it"),
        Command("select_largest", "Largest part", "", "Keep only the largest connected part"),
        Command("hide_selected", "Hide selection", "Ctrl+H", row="Hide; Shift isolates"),
        Command("isolate", "Isolate selection", "Ctrl+Shift+H", "Hide everything else", row=JOINED),
        Command("show_hidden", "Show hidden", "", "All splats that are hidden"),
        Command("remove_selected", "Remove selection", "Alt+Delete", "A layer that lets it vanish"),
        Command("move_selected", "Move selection", "Alt+M", "A layer that moves, turns and scales it"),
        Command("duplicate_selected", "Copy selection", "Alt+D", "A layer with a copy, placed by hand"),
        Command("hide_strays", "Hide strays", "", "What a capture left where nothing is"),
    ),
    "Timeline": (
        Command("play", "Play or pause", "Space"),
        Command("key", "Insert keyframe", "K", "Camera and all strengths"),
        Command("drop_key", "Delete keyframe", "Delete"),
        *_row(", .", "Previous, next frame", _steps("step", "frame", repeats=True)),
        *_row("Shift+, .", "Previous, next keyframe", _steps("jump", "keyframe", "Shift+")),
        Command("easing", "Smooth, linear, hold", "Shift+K", "From the keyframe at or before the playhead"),
        Command("ping_pong", "Ping-pong", "Alt+K", row="Ping-pong; Ctrl auto-key"),
        Command("auto_key", "Auto-key", "Ctrl+Alt+K", "A dragged slider gets a keyframe", row=JOINED),
        Command(
            "timeline", "Timeline", "T", "Animate the camera and the strengths", row="Timeline; Alt its rows"
        ),
        Command("timeline_rows", "Timeline rows", "Alt+T", "The camera and each layer", row=JOINED),
        Command("safe_frame", "Safe frame", "Shift+T", "What a film of 16:9, 1:1 or 9:16 shows"),
    ),
    "Window and files": (
        Command("palette", "All commands…", "Ctrl+P F3", "Find one by its name", types=True),
        Command("help", "Keys and mouse", "F1"),
        Command("keys_file", "Change keys…", "", "The file in which each command has its keys"),
        Command("picture", "Save picture", "F2", "As it is on screen, as PNG"),
        Command("paint_view", "Paint over this view…", "", "In your painting program; saves are shown"),
        Command("take_view", "Take this view", "Ctrl+F2", "Without edits, to be changed elsewhere"),
        Command("window_picture", "Save whole window", "Shift+F2", "As PNG"),
        Command("camera", "Save view as camera", "F4"),
        Command("snapshot", "Add snapshot", "F5", "Keep the present sliders", row="Snapshot; Shift compares"),
        Command("compare_snapshots", "Compare snapshots", "Shift+F5", "Snapshot A against B", row=JOINED),
        Command("new_edit", "New edit…", "Ctrl+N", "Choose region and editor, see it, train it", types=True),
        Command("save", "Save session", "Ctrl+S", types=True, row="Save session; Shift as…"),
        Command("save_as", "Save session as…", "Ctrl+Shift+S", types=True, row=JOINED),
        Command("open", "Open…", "Ctrl+O", "A scene, a session or an edit", types=True),
        Command("decal", "Decal…", "", "Lay a picture on a surface", types=True),
        Command(
            "export", "Export scene…", "Ctrl+E", "The edited scene", types=True, row="Export; Shift a page"
        ),
        Command("export_page", "Export web page…", "Ctrl+Shift+E", "For any browser", types=True, row=JOINED),
        Command("render_picture", "Render picture…", "Ctrl+Alt+P", "This view at any size", types=True),
        Command("render_film", "Render film…", "Ctrl+Shift+P", types=True),
        Command("dynamic_resolution", "Dynamic resolution", "Shift+F10", "Auto, on, off"),
        *_row("Ctrl + − 0", "Interface size", _zooms()),
        Command(
            "next_place:1", "Keyboard to next part", "F6 Tab", "Esc leaves it", row="Keys to panel, tools"
        ),
        Command("next_place:-1", "Keyboard to part before", "Shift+F6 Shift+Tab", row=JOINED),
        Command("reduced_motion", "Reduced motion", "", "The camera jumps where it would glide"),
        Command("full_screen", "Full screen", "F11"),
        Command("panel", "Panel", "F12", "Show or hide it and what lies over the picture"),
        Command("demo", "Try the demo", "", "Makes a scene and trains four edits of it: a minute or two"),
        Command("about", "About"),
        Command("quit", "Quit", "Ctrl+Q"),
    ),
}
COMMANDS = {command.action: command for commands in TOPICS.values() for command in commands}
KEYS: dict[str, Command] = {}
HAND_KEYS: dict[str, Command] = {}
"""By its chord, what each key does, and what it does before that with a tool in the hand; see `bind`."""
NAMES = (
    *"ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789\\[],.=-",
    *(f"F{i}" for i in range(1, 13)),
    *("Left", "Right", "Up", "Down", "Escape", "Tab", "Enter", "Backspace", "Space", "Delete"),
    *(f"Num{i}" for i in (*range(10), ".")),
)
"""Keys that the window tells apart."""


def bind(changes: Mapping[str, Any]) -> list[str]:
    """The keys of the table, but for those of some actions; what is wrong with these, a line for each.

    Args:
        changes: by its action a chord, several or "" for none; a key that was another one's is no longer that
    """
    problems = list[str]()
    changed = list[Command]()
    given: dict[tuple[str, bool], Command] = {}
    for action, value in changes.items():
        texts = [value] * bool(value) if isinstance(value, str) else value
        try:
            if action not in COMMANDS:
                raise ValueError("there is no such command")
            if not (isinstance(texts, list) and all(isinstance(text, str) for text in texts)):
                raise ValueError('keys are written as "F6" or ["F6", "Ctrl+B"]')
            command = COMMANDS[action]
            taken = {(parse_chord(text), command.in_hand): command for text in texts}
            if twice := [key for key in taken if key in given]:
                raise ValueError(f"{twice[0][0]} is that of {given[twice[0]].action} already")
            if flies := [chord for chord, _ in taken if chord in FLY_KEYS]:
                raise ValueError(f"{flies[0]} flies")
            given.update(taken)
            changed.append(COMMANDS[action])
        except ValueError as error:
            problems.append(f"{action}: {error}")
    KEYS.clear()
    HAND_KEYS.clear()
    chords.cache_clear()
    for command in COMMANDS.values():
        mine = [chord for (chord, _), other in given.items() if other is command]
        own = [] if command in changed else command.keys.split()
        kept = [chord for chord in own if (chord, command.in_hand) not in given]
        (HAND_KEYS if command.in_hand else KEYS).update(dict.fromkeys([*mine, *kept], command))
    return problems


def parse_chord(text: str) -> str:
    """A chord as a person writes it, as in `KEYS`.

    Raises:
        ValueError: there is no such key.
    """
    *modifiers, key = (part.strip().capitalize() for part in text.strip().rsplit("+"))
    if key not in NAMES or not {*modifiers} <= {*_MODIFIERS}:
        raise ValueError(f"there is no key {text}")
    return "+".join([*(name for name in _MODIFIERS if name in modifiers), key])


_MODIFIERS = ("Ctrl", "Shift", "Alt")


def is_changed(command: Command) -> bool:
    """Whether the person has given it other keys, or its own to another one."""
    return bound_chords(command) != command.keys.split()


def bound_chords(command: Command) -> list[str]:
    """The keys that a command has."""
    keys = HAND_KEYS if command.in_hand else KEYS
    return [chord for chord, other in keys.items() if other is command]


@cache  # each frame's tips and menus ask for a hundred
def chords(action: str) -> tuple[str, ...]:
    """All keys of an action, in a person's words; none of what is no command."""
    bound = bound_chords(COMMANDS[action]) if action in COMMANDS else []
    return tuple(
        chord.replace("Delete", "Del").replace("Num", "Numpad ").replace("Escape", "Esc") for chord in bound
    )


bind({})


def shortcut(action: str) -> str:
    """The first key of an action, in a person's words; "" where there is none."""
    return next(iter(chords(action)), "")


def describe(action: str, more: str = "") -> str:
    """A tip: the name with its key, what it does, and what there is to say beside."""
    command = COMMANDS[action]
    chord = shortcut(action)
    first = command.name + (f" ({chord})" if chord else "")
    return "\n".join(line for line in (first, command.help, more) if line)


def match(query: str, name: str, beside: str = "") -> int | None:
    """How well a name answers to what is sought: 0 best, None not at all.

    Args:
        beside: what is read where the name does not answer
    """
    sought = query.casefold().strip()
    text = name.casefold()
    letters = iter(name.casefold())
    answers = (
        text.startswith(sought),
        f" {sought}" in text,
        "".join(word[0] for word in text.split()).startswith(sought),
        sought in text,
        sought in beside.casefold(),
        all(letter in letters for letter in sought.replace(" ", "")),  # in this order, with others between
    )
    return next((i for i, answer in enumerate(answers) if answer), None)


def find_commands(query: str, offered: Collection[str]) -> list[Command]:
    """Those of the actions offered that are called like that, the best first; all for ""."""
    ranks = [
        (match(query, command.name, f"{command.help} {topic} {' '.join(chords(command.action))}"), command)
        for topic, commands in TOPICS.items()
        for command in commands
        if command.action in offered
    ]
    found = [(rank, bool(command.listed), command) for rank, command in ranks if rank is not None]
    return [command for *_, command in sorted(found, key=lambda answer: answer[:2])]


def drag_for(button: str, modifier: str, mode: str) -> str | None:
    """What a drag does, or None where nothing is bound. `modifier`: "", "Shift", "Ctrl" or "Alt"."""
    if (button, modifier, mode) == ("right", "", "fly"):
        return "look"
    return DRAGS.get(f"{modifier}+{button}" if modifier else button)


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


def has_reached_imgui(press: Press) -> bool:
    """Whether imgui, which takes text and keys in over several frames, has come to this key.

    A key that comes before its time would overtake what was typed before it.
    """
    waiting = imgui.get_current_context().input_events_queue
    return waiting.empty() or waiting[0].event_id > press.event_id


def opens_text(press: Press) -> bool:
    """Whether a key asks for a text field: it needs some frames until it has the keyboard."""
    command = KEYS.get(press.chord)
    return command is not None and command.types and not imgui.get_io().want_text_input


def has_pending_input() -> bool:
    """Whether imgui still holds input that its next frames take in."""
    return not imgui.get_current_context().input_events_queue.empty()


def end_frame_here() -> None:
    """What imgui hears from now on is of its next frame: else a slow frame, which hears at once that Tab went
    down and Shift up, would take a quick Shift+Tab for Tab."""
    for down in (True, False):  # the second event of a key waits for the next frame; no keyboard has this one
        imgui.get_io().add_key_event(imgui.Key.f24, down)


def next_event_id() -> int:
    """The place that the next event takes among imgui's input events."""
    return int(imgui.get_current_context().input_events_next_event_id)


def requested_actions(keys: Keys) -> list[str]:
    """Actions of `KEYS` that were asked for; none while a text field is open."""
    if imgui.get_io().want_text_input:
        return []
    pressed = [(KEYS[press.chord], press.again) for press in keys.pressed if press.chord in KEYS]
    return [key.action for key, again in pressed if key.repeats or not again]


def is_repeating(keys: Keys) -> bool:
    """Whether a key that repeats is held: what it does is not over yet."""
    held = keys.held
    return bool(held) and any(key.repeats and chord.rpartition("+")[2] in held for chord, key in KEYS.items())


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


def cancels_drag(keys: Keys, held: bool, drag: str | None) -> bool:
    """Whether Escape or the right button takes back what the left button is dragging.

    Args:
        held: something of the interface was held in the last frame: imgui lets go of it at Escape
        drag: what is held on the picture, see `mouse.MouseTool`; the camera stays where it was turned
    """
    io = imgui.get_io()
    buttons = imgui.MouseButton_
    holds = held or drag not in (None, "look", *DRAGS.values())
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
            count = opener + 1
            self._opened_at = self._frames
        self._waiting = pressed[count:]
        return replace(keys, pressed=pressed[:count])
