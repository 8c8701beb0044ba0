"""Commands as frozen data. Keys, panel, dialogs and tests create them; `actions.perform` applies them.

The window applies the commands that need files, jobs or the screen. Only the table of keys and its file write
commands as text, see `parse_action`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Plain:
    """Command without an argument. It applies to the focused layer, if it needs one."""

    name: str


@dataclass(frozen=True)
class OnItem:
    """Command on one item of a list."""

    name: str
    # of a layer, snapshot, region, undo entry, job or timeline row; or a number in the panel, from 1
    index: int


@dataclass(frozen=True)
class WithValue:
    """Command with a number: a step, a factor, a strength or a frame."""

    name: str
    value: float


@dataclass(frozen=True)
class WithText:
    """Command with a text: a tool, a view direction, a group's name or a file."""

    name: str
    text: str


@dataclass(frozen=True)
class Rename:
    """Command that renames a group, snapshot or region."""

    name: str  # "rename_group", "name_snapshot" or "rename_region"
    index: int
    text: str  # the new name


@dataclass(frozen=True)
class PressLayer:
    """Press on the card of a layer, which changes the focus and the selected layers."""

    name: ClassVar[str] = "press_layer"
    how: str  # one of `layer_selection.PRESSES`
    index: int  # of the layer
    listed: tuple[int, ...] = ()  # the layers in the panel's list; a range covers only these


@dataclass(frozen=True)
class SelectRegion:
    """Command that selects the members of a region."""

    name: ClassVar[str] = "region"
    index: int
    mode: str = "new"  # a mode of `progdf.scene.selection.combine`


@dataclass(frozen=True)
class MoveSnapshot:
    """Command that moves a snapshot in the panel; the original has index 0."""

    name: ClassVar[str] = "move_snapshot"
    index: int
    to: int


@dataclass(frozen=True)
class ChooseSnapshot:
    """Command that chooses a snapshot for one side of the compared pair."""

    name: ClassVar[str] = "choose_snapshot"
    slot: str  # "a" or "b"
    snapshot: str  # its name


@dataclass(frozen=True)
class ChooseKeys:
    """Command that selects timeline keys."""

    name: ClassVar[str] = "choose_keys"
    keys: frozenset[tuple[int, int]] = frozenset()  # row and frame of each
    toggles: bool = False  # toggle these keys and keep the others


@dataclass(frozen=True)
class MovePointer:
    """Command that moves a tool's pointer, in pixels at 1×."""

    name: ClassVar[str] = "point"
    x: float
    y: float


@dataclass(frozen=True)
class Save:
    """Command that saves the session and then performs another command."""

    name: ClassVar[str] = "save"
    then: Action


@dataclass(frozen=True)
class ReplaceEdit:
    """Command that replaces the edit of a layer by one from a file."""

    name: ClassVar[str] = "replace_by"
    index: int | None  # of the layer; None for the focused one
    path: str


@dataclass(frozen=True)
class RebindEdit:
    """Command that rebinds an edit of another scene to the open one."""

    name: ClassVar[str] = "rebind_from"
    edit: str  # file of the edit
    scene: str  # file of its scene


Action = (
    Plain
    | OnItem
    | WithValue
    | WithText
    | Rename
    | PressLayer
    | SelectRegion
    | MoveSnapshot
    | ChooseSnapshot
    | ChooseKeys
    | MovePointer
    | Save
    | ReplaceEdit
    | RebindEdit
)
Argument = None | int | float | str | Action


def argument(action: Action) -> Argument:
    """Return the argument of a command for its handler; the command itself if it has several fields."""
    match action:
        case Plain():
            return None
        case OnItem(_, index):
            return index
        case WithValue(_, value):
            return value
        case WithText(_, text):
            return text
        case Save(then):
            return then
    return action


_OF_TEXT = ("look", "navigate", "select_tool", "paint_tool", "view_mode")
_OF_NUMBER = ("focus", "toggle")


def parse_action(text: str) -> Action:
    """Return the command of a text such as `fly`, `look:top` or `nudge:0.01`, as written in the keys file."""
    name, _, given = text.partition(":")
    if not given:
        return Plain(name)
    if name in _OF_TEXT:
        return WithText(name, given)
    if name in _OF_NUMBER:
        return OnItem(name, int(given))
    if name == MovePointer.name:
        x, y = given.split(",")
        return MovePointer(float(x), float(y))
    return WithValue(name, float(given))
