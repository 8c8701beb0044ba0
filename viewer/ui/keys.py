"""Table of all commands with their keys, table of mouse drags, and translation of input into actions.

Menus, tooltips, the list of keys and the command palette are built from the table of commands.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from imgui_bundle import imgui

from viewer.camera import controls
from viewer.camera.view_camera import ViewCamera
from viewer.state.commands import Action, parse_action


@dataclass(frozen=True)
class Command:
    """Action of `actions.perform` with the texts and keys that the user sees."""

    id: str  # text form of the action, see `parse_action`; also its name in the keys file
    name: str  # shown in menus, tooltips, the list of keys and the palette
    keys: str = ""  # chords separated by spaces: modifiers in the order Ctrl, Shift, Alt, then the key's name
    help: str = ""  # text of the tooltip below the name
    repeats: bool = False  # repeats while the key is held
    types: bool = False  # opens a text field
    row: str = ""  # text of a row of several commands in the list of keys; `JOINED` for the later ones
    listed: str = ""  # keys shown there instead of `keys`
    in_hand: bool = False  # for an active tool or decal; its keys then have priority

    @property
    def action(self) -> Action:
        return parse_action(self.id)


DRAGS = {
    "left": "orbit",
    "Alt+left": "orbit",
    "middle": "orbit",
    "Shift+middle": "pan",
    "Ctrl+middle": "dolly",
    "right": "pan",
}
"""Action of a mouse drag on the picture. In fly mode, a right drag without modifier looks around."""


FLY_KEYS = {"W": (0, 0, 1), "S": (0, 0, -1), "A": (-1, 0, 0), "D": (1, 0, 0), "Q": (0, -1, 0), "E": (0, 1, 0)}
"""Physical keys (positions on a US keyboard) → right, up, ahead."""

NUDGES = (("", 0.01), ("Shift+", 0.10), ("Ctrl+", 0.001))
"""Modifier of an arrow key, and its step of a slider."""


JOINED = "-"
"""Row text of a command that shares the row of the previous command."""


def _row(listed: str, does: str, commands: Iterable[Command]) -> Iterator[Command]:
    """Return commands that share a row of the list of keys."""
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


def _view_commands() -> Iterator[Command]:
    for key, side, other in (("Num1", "front", "back"), ("Num3", "right", "left"), ("Num7", "top", "bottom")):
        yield Command(f"look:{side}", f"View from the {side}", key)
        yield Command(f"look:{other}", f"View from the {other}", f"Ctrl+{key}")


def _steps(action: str, what: str, modifier: str = "", repeats: bool = False) -> Iterator[Command]:
    yield Command(f"{action}:-1", f"Previous {what}", f"{modifier},", repeats=repeats)
    yield Command(f"{action}:1", f"Next {what}", f"{modifier}.", repeats=repeats)


def _zooms() -> Iterator[Command]:
    yield Command("zoom:1.1", "Larger interface", "Ctrl+= Ctrl+Shift+=")
    yield Command("zoom:0.9091", "Smaller interface", "Ctrl+-")
    yield Command("zoom:0", "Reset interface size", "Ctrl+0")


MODES = "Shift adds, Ctrl subtracts, both intersect"
_CORNERS = f"Click its corners; Enter or a double click closes it. {MODES}"

TOPICS: dict[str, tuple[Command, ...]] = {
    "View": (
        Command("fly", "Orbit or fly", "V"),
        Command("navigate:orbit", "Orbit", "", "Around a pivot"),
        Command("navigate:fly", "Fly", "", "W A S D, Q E; right drag looks around"),
        Command("frame", "Frame", "F Num.", "The selection, the selected layer, or the scene"),
        Command("home", "Reset the view", "Shift+F Num0"),
        Command("flip_up", "Flip the up axis", "", "Turn a scene that stands on its head"),
        Command("view_settings", "View settings…", "", "Up axis, view angle, background, grid"),
        *_row("Numpad 1 3 7", "Front, right, top", _view_commands()),
        Command("grid", "Ground grid", "Shift+G", row="Ground grid; measure"),
        Command("measure", "Measure", "Shift+M", "Distance of two points; its true length", row=JOINED),
        Command("axes", "Axes"),
        Command("cameras", "Training cameras", "Shift+C", "Click one to look through it"),
        Command(
            "next_view_mode",
            "Next view mode",
            "Z",
            "Splats, centers, rings, depth and more",
            row="View mode; Shift splats",
        ),
        Command("view_mode:splats", "Show splats", "Shift+Z", "The scene as it is", row=JOINED),
        Command("view_mode:centers", "Show centers", "", "A dot per splat"),
        Command("view_mode:rings", "Show rings", "", "The outline of each splat"),
        Command("view_mode:depth", "Show depth", "", "Yellow is near, blue is far"),
        Command("view_mode:normals", "Show normals", "", "Shortest axis: red right, green up, blue to you"),
        Command(
            "view_mode:contribution", "Show contribution", "", "The splats that make the pixel you point at"
        ),
        Command("view_mode:opacity", "Show opacity", "", "Blue is transparent, yellow is opaque"),
        Command("before", "Original", "\\", "Until pressed again, or until a slider moves"),
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
        Command("show_all", "Show all", "Alt+H", "All layers and all hidden splats"),
        Command("lock", "Lock", "Shift+L", "Protect strength, gains and paint from changes"),
        Command("fold", "Details and gains", "G", "Size, instruction and gains"),
        Command("cards", "Compact rows", "Alt+G"),
        Command("rename", "Rename…", "Enter", types=True),
        Command("duplicate", "Duplicate", "Ctrl+D"),
        Command("replace", "Replace…", "", "Replace its edit by another one"),
        Command("again", "Again with other settings", "", "Open the form with the settings of this edit"),
        Command(
            "copy_edit",
            "Copy settings",
            "Ctrl+Shift+C",
            "Of the form or the layer",
            row="Copy, paste settings",
            listed="Ctrl+Shift+C, V",
        ),
        Command("paste_edit", "Paste settings", "Ctrl+Shift+V", "Opens the form, in any scene", row=JOINED),
        Command("remove", "Delete", "Ctrl+Delete"),
        Command("limit_to_selection", "Limit to the selection", "", "Set the paint outside it to 0"),
        Command(
            "select_painted", "Select affected part", "", "Its region, without parts whose paint is below 0.5"
        ),
        Command("move:-1", "Move up", "Alt+Up", "Higher layers are applied later", row="Move up, down"),
        Command("move:1", "Move down", "Alt+Down", row=JOINED),
        Command("select_layers", "Select all layers", "Ctrl+Alt+A"),
        Command("group", "New group", "Ctrl+G", "With its own strength", row="Group; Shift ungroups"),
        Command("ungroup", "Ungroup", "Ctrl+Shift+G", row=JOINED),
        Command("reset", "Reset values", "Ctrl+R", "Strength 0, gains 1", row="Reset values; Shift all"),
        Command("reset_all", "Reset all layers", "Ctrl+Shift+R", row=JOINED),
        Command("search", "Search layers…", "Ctrl+F", types=True),
    ),
    "Edits": (
        Command("blend", "Next blend rule", "M", "Of the selected layer, or else of all layers"),
        Command("overshoot", "Overshoot to 1.2", "O", "Sliders extrapolate past the trained range"),
        Command("unfocus", "Leave tool, deselect", "Escape"),
        Command("undo", "Undo", "Ctrl+Z", repeats=True),
        Command("redo", "Redo", "Ctrl+Shift+Z Ctrl+Y", repeats=True),
        Command("copy_keys", "Copy keyframes", "Ctrl+C", "The selected keyframes", row="Copy, paste keys"),
        Command("paste_keys", "Paste keyframes", "Ctrl+V", "At the playhead", row=JOINED),
        Command("history", "History…", "Ctrl+Alt+Z", "All changes; click one to return to it"),
    ),
    "Color": (
        Command("paint_tool:color", "Color brush", "Alt+B", "Paint on the surface; Alt+click picks a color"),
        Command("paint_tool:clone", "Clone stamp", "Alt+C", "Alt+click sets the source to copy from"),
        Command("finish_paint", "Done painting", "Alt+Enter", "Turn the paint into a layer with a slider"),
        Command("clipping", "Clipped colors", "", "Of the form's grade: white in red, black in blue"),
        Command("discard_paint", "Discard paint", "", "Remove all paint that is not a layer yet"),
    ),
    "Brush": (
        Command("brush", "Paint strength", "B", "Left-drag over the selected layer"),
        Command("brush_mode", "Erase, smooth, add", "X"),
        Command(
            "brush_through", "Front or through", "Shift+B", "The front surface, or also everything behind it"
        ),
        Command("brush_weights", "Weights as colors", "C"),
        Command("brush_radius:0.8", "Smaller", "[", repeats=True, row="Radius, or tolerance"),
        Command("brush_radius:1.25", "Larger", "]", repeats=True, row=JOINED),
        Command("brush_softness:-0.1", "Harder", "Shift+[", repeats=True, row="Harder, softer"),
        Command("brush_softness:0.1", "Softer", "Shift+]", repeats=True, row=JOINED),
        Command(
            "paint_clear", "Clear the paint", "Backspace", "Weights to 0", row="Clear paint; Shift fills"
        ),
        Command("paint_fill", "Fill with paint", "Shift+Backspace", "Weights to 1", row=JOINED),
        Command("paint_invert", "Invert the paint", "", "Swap painted and unpainted parts"),
        Command("paint_feather", "Feather the paint", "Shift+X", "Soften its edges; repeat for more"),
    ),
    "Select": (
        Command("select_tool:box", "Box", "R", MODES),
        Command("select_tool:lasso", "Lasso", "L", MODES),
        Command("select_tool:polygon", "Polygon", "P", _CORNERS),
        Command("select_tool:brush", "Selection brush", "U", MODES),
        Command("select_tool:scribble", "Scribble", "Shift+U", "Strokes on object and background (Ctrl)"),
        Command("select_tool:sphere", "Sphere", "Shift+R", f"Drag from its center on a surface. {MODES}"),
        Command(
            "select_tool:flood",
            "Flood selection",
            "J",
            f"Click: connected splats of similar color. {MODES}",
            row="Flood; Shift the subject",
        ),
        Command("select_subject", "Select subject", "Shift+J", "The object in the middle", row=JOINED),
        Command("select_tool:color", "Color selection", "I", f"Click: all splats of similar color. {MODES}"),
        *_row("← → ↑ ↓", "Tool pointer; Shift far", _points()),
        Command(
            "point_press",
            "Press or release",
            "Space Enter Shift+Space Ctrl+Space Ctrl+Shift+Space",
            "Like the mouse button: corners, clicks, or a drag until pressed again",
            row="Tool: press, release",
            listed="Space Enter",
            in_hand=True,
        ),
        Command("select_through", "Front or through", "N", "The front surface, or also everything behind it"),
        Command("select_all", "Select everything", "Ctrl+A", row="All; Shift nothing"),
        Command("select_none", "Select nothing", "Ctrl+Shift+A", row=JOINED),
        Command("invert", "Invert", "Ctrl+I", "Select everything else; while painting, invert the paint"),
        Command("select_shrink", "Shrink", "Ctrl+[", "Remove its border", repeats=True, row="Shrink, grow"),
        Command("select_grow", "Grow", "Ctrl+]", "Add the neighbors", repeats=True, row=JOINED),
        Command("select_smooth", "Smooth", "", "Smooth the border, remove isolated splats, fill holes"),
        Command("select_refine", "Refine", "", "Align the edge with color and depth edges"),
        Command("select_largest", "Largest part", "", "Keep only the largest connected part"),
        Command("select_with_paint", "With paint", "", "Add the paint on the selected object"),
        Command("select_without_paint", "Without paint", "", "Remove all paint from the selection"),
        Command("select_paint", "Only the paint", "", "Select only the paint on the object"),
        Command("hide_selected", "Hide selection", "Ctrl+H", row="Hide; Shift isolates"),
        Command("isolate", "Isolate selection", "Ctrl+Shift+H", "Hide everything else", row=JOINED),
        Command("show_hidden", "Show hidden", "", "All splats that are hidden"),
        Command("remove_selected", "Remove selection", "Alt+Delete", "Add a layer that removes it"),
        Command(
            "move_selected",
            "Move selection",
            "Alt+M",
            "Add a layer that moves, rotates and scales it",
            row="Move selection; pull",
        ),
        Command("pull", "Pull", "Shift+P", "Drag the surface, and the rest follows", row=JOINED),
        Command("duplicate_selected", "Copy selection", "Alt+D", "Add a layer with a copy to place"),
        Command("histogram", "Histogram", "Shift+I", "Drag a range of size, opacity, color … to select"),
        Command("hide_strays", "Hide strays", "", "Floaters, needles, giants and invisible splats"),
    ),
    "Timeline": (
        Command("play", "Play or pause", "Space"),
        Command("key", "Insert keyframe", "K", "Camera and all strengths"),
        Command("drop_key", "Delete keyframe", "Delete"),
        *_row(", .", "Previous, next frame", _steps("step", "frame", repeats=True)),
        *_row("Shift+, .", "Previous, next keyframe", _steps("jump", "keyframe", "Shift+")),
        Command("easing", "Smooth, linear, hold", "Shift+K", "From the keyframe at or before the playhead"),
        Command("ping_pong", "Ping-pong", "Alt+K", row="Ping-pong; Ctrl auto-key"),
        Command("auto_key", "Auto-key", "Ctrl+Alt+K", "A changed slider gets a keyframe", row=JOINED),
        Command(
            "timeline", "Timeline", "T", "Animate the camera and the strengths", row="Timeline; Alt its rows"
        ),
        Command("timeline_rows", "Timeline rows", "Alt+T", "The camera and each layer", row=JOINED),
        Command("safe_frame", "Safe frame", "Shift+T", "Frame of a 16:9, 1:1 or 9:16 film"),
    ),
    "Window and files": (
        Command("palette", "All commands…", "Ctrl+P F3", "Find a command by its name", types=True),
        Command("help", "Keys and mouse", "F1"),
        Command("keys_file", "Change keys…", "", "Open the file with the keys of all commands"),
        Command("picture", "Save picture", "F2", "As shown on screen, as PNG"),
        Command("paint_view", "Paint over this view…", "", "In your painting program; each save is shown"),
        Command("take_view", "Take this view", "Ctrl+F2", "Without edits, to be edited elsewhere"),
        Command("window_picture", "Save whole window", "Shift+F2", "As PNG"),
        Command("camera", "Save view as camera", "F4"),
        Command("snapshot", "Add snapshot", "F5", "Store the sliders", row="Snapshot; Shift compares"),
        Command("compare_snapshots", "Compare snapshots", "Shift+F5", "Snapshot A against B", row=JOINED),
        Command("new_edit", "New edit…", "Ctrl+N", "Choose region and editor, preview, train", types=True),
        Command("new_grade", "New grade…", "", "Light, color, wheels, curves and looks", types=True),
        Command("show_looks", "Show looks folder", "", "To rename, delete and add looks of grades"),
        Command("save", "Save session", "Ctrl+S", types=True, row="Save session; Shift as…"),
        Command("save_as", "Save session as…", "Ctrl+Shift+S", types=True, row=JOINED),
        Command("open", "Open…", "Ctrl+O", "A scene, a session or an edit", types=True),
        Command("add_scene", "Add scene…", "", "A second scene in this view", types=True),
        Command("decal", "Decal…", "", "Place a picture on a surface", types=True),
        Command(
            "export", "Export scene…", "Ctrl+E", "The edited scene", types=True, row="Export; Shift a page"
        ),
        Command("export_page", "Export web page…", "Ctrl+Shift+E", "For any browser", types=True, row=JOINED),
        Command("render_picture", "Render picture…", "Ctrl+Alt+P", "This view at any size", types=True),
        Command("render_film", "Render film…", "Ctrl+Shift+P", types=True),
        Command("dynamic_resolution", "Dynamic resolution", "Shift+F10", "Auto, on, off"),
        *_row("Ctrl + − 0", "Interface size", _zooms()),
        Command(
            "next_place:1", "Focus next part", "F6 Tab", "By keyboard; Esc leaves it", row="Keyboard focus"
        ),
        Command("next_place:-1", "Focus previous part", "Shift+F6 Shift+Tab", row=JOINED),
        Command("reduced_motion", "Reduced motion", "", "The camera jumps instead of gliding"),
        Command("status", "Status line", "Shift+F1", "Splats, visible, frames per second, memory"),
        Command("full_screen", "Full screen", "F11"),
        Command("panel", "Panel", "F12", "Show or hide the panel and all overlays"),
        Command("tour", "Show the tour", "", "Five steps: move, slide, scribble, grade, share"),
        Command("demo", "Train the demo", "", "Create a scene and train four edits: one to two minutes"),
        Command("about", "About"),
        Command("quit", "Quit", "Ctrl+Q"),
    ),
}
COMMANDS = {command.id: command for commands in TOPICS.values() for command in commands}
KEYS: dict[str, Command] = {}
"""Command of each chord; filled by `bind`."""
TOOL_KEYS: dict[str, Command] = {}
"""Command of each chord that has priority while a tool is active; filled by `bind`."""
NAMES = (
    *"ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789\\[],.=-",
    *(f"F{i}" for i in range(1, 13)),
    *("Left", "Right", "Up", "Down", "Escape", "Tab", "Enter", "Backspace", "Space", "Delete"),
    *(f"Num{i}" for i in (*range(10), ".")),
)
"""Keys that the window distinguishes."""


def bind(changes: Mapping[str, Any]) -> list[str]:
    """Set the keys of all commands and return the errors, one line each.

    Args:
        changes: by action, its chord, several chords, or "" for none; a chord is taken away from other
            commands
    """
    problems = list[str]()
    changed = list[Command]()
    given: dict[tuple[str, bool], Command] = {}
    for action, value in changes.items():
        texts = value
        if isinstance(value, str):
            texts = [value] if value else []
        try:
            if action not in COMMANDS:
                raise ValueError("there is no such command")
            if not (isinstance(texts, list) and all(isinstance(text, str) for text in texts)):
                raise ValueError('keys are written as "F6" or ["F6", "Ctrl+B"]')
            command = COMMANDS[action]
            chosen = {(parse_chord(text), command.in_hand): command for text in texts}
            if twice := [key for key in chosen if key in given]:
                raise ValueError(f"{twice[0][0]} is already assigned to {given[twice[0]].id}")
            if flies := [chord for chord, _ in chosen if chord in FLY_KEYS]:
                raise ValueError(f"{flies[0]} is a flight key")
            given.update(chosen)
            changed.append(COMMANDS[action])
        except ValueError as error:
            problems.append(f"{action}: {error}")
    KEYS.clear()
    TOOL_KEYS.clear()
    chords.cache_clear()
    for command in COMMANDS.values():
        new_chords = [chord for (chord, _), other in given.items() if other is command]
        table_chords = [] if command in changed else command.keys.split()
        remaining_chords = [chord for chord in table_chords if (chord, command.in_hand) not in given]
        (TOOL_KEYS if command.in_hand else KEYS).update(
            dict.fromkeys([*new_chords, *remaining_chords], command)
        )
    return problems


def parse_chord(text: str) -> str:
    """Parse a chord typed by a user into the form of `KEYS`.

    Raises:
        ValueError: there is no such key.
    """
    *modifiers, key = (part.strip().capitalize() for part in text.strip().rsplit("+"))
    if key not in NAMES or not {*modifiers} <= {*_MODIFIERS}:
        raise ValueError(f"there is no key {text}")
    return "+".join([*(name for name in _MODIFIERS if name in modifiers), key])


_MODIFIERS = ("Ctrl", "Shift", "Alt")


def is_changed(command: Command) -> bool:
    """Return whether the user changed the keys of a command, directly or by giving them to another."""
    return bound_chords(command) != command.keys.split()


def bound_chords(command: Command) -> list[str]:
    """Return the chords of a command."""
    keys = TOOL_KEYS if command.in_hand else KEYS
    return [chord for chord, other in keys.items() if other is command]


@cache  # tooltips and menus call this a hundred times per frame
def chords(command: str) -> tuple[str, ...]:
    """Return all chords of a command as shown to the user; none for an unknown one."""
    bound = bound_chords(COMMANDS[command]) if command in COMMANDS else []
    return tuple(
        chord.replace("Delete", "Del").replace("Num", "Numpad ").replace("Escape", "Esc") for chord in bound
    )


bind({})


def shortcut(action: str) -> str:
    """Return the first chord of an action as shown to the user; "" if it has none."""
    return next(iter(chords(action)), "")


def describe(action: str, more: str = "") -> str:
    """Return a tooltip: the name with its chord, the help text, and `more`."""
    command = COMMANDS[action]
    chord = shortcut(action)
    first = command.name + (f" ({chord})" if chord else "")
    return "\n".join(line for line in (first, command.help, more) if line)


def drag_for(button: str, modifier: str, mode: str) -> str | None:
    """Return the action of a drag, None if unbound. `modifier`: "", "Shift", "Ctrl" or "Alt"."""
    if (button, modifier, mode) == ("right", "", "fly"):
        return "look"
    return DRAGS.get(f"{modifier}+{button}" if modifier else button)


_BUTTONS = (("left", 0), ("right", 1), ("middle", 2))


@dataclass(frozen=True)
class Press:
    """Key press with the modifiers held at that moment."""

    chord: str  # in the form of `KEYS`
    again: bool = False  # repeated while the key is held
    event_id: int = -1  # index in imgui's input events (see `has_reached_imgui`); −1 precedes all


@dataclass(frozen=True)
class Keys:
    """Keyboard input since the last frame.

    It does not come from imgui, which merges the events of a slow frame and would lose the Ctrl of a quick
    Ctrl+Z.
    """

    pressed: tuple[Press, ...] = ()  # in the order of the presses
    held: frozenset[str] = frozenset()  # names of the held keys, as in the chords of `KEYS`
    fly: frozenset[str] = frozenset()  # held keys of `FLY_KEYS`, by their physical position


NO_KEYS = Keys()


def has_reached_imgui(press: Press) -> bool:
    """Return whether imgui has processed all input that precedes this key.

    imgui spreads text and keys over several frames. A key handled earlier would overtake text typed before.
    """
    waiting = imgui.get_current_context().input_events_queue
    return waiting.empty() or waiting[0].event_id > press.event_id


def opens_text(press: Press) -> bool:
    """Return whether a key opens a text field, which receives the keyboard only some frames later."""
    command = KEYS.get(press.chord)
    return command is not None and command.types and not imgui.get_io().want_text_input


def has_pending_input() -> bool:
    """Return whether imgui still queues input for its next frames."""
    return not imgui.get_current_context().input_events_queue.empty()


def end_frame_here() -> None:
    """Make imgui assign later input to its next frame.

    Otherwise a slow frame receives Tab down and Shift up together and takes a quick Shift+Tab for Tab.
    """
    for down in (True, False):  # the key's second event waits for the next frame; no keyboard has F24
        imgui.get_io().add_key_event(imgui.Key.f24, down)


def next_event_id() -> int:
    """Return the index that the next event gets in imgui's input events."""
    return int(imgui.get_current_context().input_events_next_event_id)


def requested_commands(keys: Keys) -> list[Command]:
    """Return the requested commands of `KEYS`; none while a text field is open."""
    if imgui.get_io().want_text_input:
        return []
    pressed = [(KEYS[press.chord], press.again) for press in keys.pressed if press.chord in KEYS]
    return [key for key, again in pressed if key.repeats or not again]


def is_repeating(keys: Keys) -> bool:
    """Return whether a repeating key is held, so that its action is not over yet."""
    held = keys.held
    return bool(held) and any(key.repeats and chord.rpartition("+")[2] in held for chord, key in KEYS.items())


def modifier() -> str:
    """Return the modifier that decides the action of a drag."""
    io = imgui.get_io()
    if io.key_shift:
        return "Shift"
    if io.key_ctrl:
        return "Ctrl"
    return "Alt" if io.key_alt else ""


def started_drag(mode: str) -> str | None:
    """Return the action of the button pressed over the picture in this frame, or None."""
    for name, button in _BUTTONS:
        if imgui.is_mouse_clicked(button):
            return drag_for(name, modifier(), mode)
    return None


def any_button_down() -> bool:
    return any(imgui.is_mouse_down(button) for _, button in _BUTTONS)


def cancels_drag(keys: Keys, held: bool, drag: str | None) -> bool:
    """Return whether Escape or the right button cancels the drag of the left button.

    Args:
        held: an item of the interface was active in the last frame; imgui releases it on Escape
        drag: drag on the picture, see `transient.MouseTool`; camera drags are not canceled
    """
    io = imgui.get_io()
    buttons = imgui.MouseButton_
    holds = held or drag not in (None, "look", *DRAGS.values())
    if not holds or io.want_text_input or not imgui.is_mouse_down(buttons.left.value):
        return False
    escape = any(press.chord == "Escape" for press in keys.pressed)
    return escape or bool(imgui.is_mouse_clicked(buttons.right.value))


def is_flying(keys: Keys) -> bool:
    """Return whether flight keys are held, outside of a chord and of a text field."""
    io = imgui.get_io()
    return bool(keys.fly) and not (io.want_text_input or io.key_ctrl or io.key_super)


def fly_by_keys(camera: ViewCamera, keys: Keys, seconds: float, radius: float) -> ViewCamera:
    """Return the camera after flying for `seconds` by the held keys; `radius`: the scene's, world units."""
    io = imgui.get_io()
    right, up, ahead = (sum(FLY_KEYS[key][i] for key in keys.fly) for i in range(3))
    pace = 0.1 if io.key_alt else 1.0
    if io.key_shift:
        pace = 10.0
    return controls.fly(camera, right, up, ahead, seconds, radius, pace)


OPENING_FRAMES = 4
"""Frames between the request for a text field and its keyboard focus."""


class PendingKeys:
    """Queue that passes keys on in step with imgui and holds them while a text field opens."""

    def __init__(self) -> None:
        self._waiting: tuple[Press, ...] = ()
        self._frames = 0
        self._opened_at = -OPENING_FRAMES  # frame of the last request for a text field

    @property
    def opening(self) -> bool:
        """True while a requested text field does not have the keyboard yet."""
        return self._frames - self._opened_at < OPENING_FRAMES and not imgui.get_io().want_text_input

    def take(self, keys: Keys) -> Keys:
        """Return the keys of this frame that imgui has reached; call once a frame."""
        pressed = (*self._waiting, *keys.pressed)
        count = 0 if self.opening else sum(1 for _ in itertools.takewhile(has_reached_imgui, pressed))
        opener = next((i for i, press in enumerate(pressed[:count]) if opens_text(press)), None)
        self._frames += 1
        if opener is not None:
            count = opener + 1
            self._opened_at = self._frames
        self._waiting = pressed[count:]
        return replace(keys, pressed=pressed[:count])
