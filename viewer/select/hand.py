"""The mouse while a tool selects: what begins, follows and ends a gesture."""

from __future__ import annotations

from dataclasses import replace

from imgui_bundle import imgui

from progdf.scene.selection import Mask, combine
from viewer.state import history, selection
from viewer.state.selection import unpack
from viewer.state.workspace import Workspace
from viewer.ui.keys import Keys
from viewer.ui.pointer import PointerContext

from .gesture import Click, Gesture, begin, clicked, enclosed, extend

DRAG = "select"
"""What a left drag does while a tool selects, beside those of `keys.DRAGS`."""

_TRAVEL_PX = 3.0  # at 1×: what moves no further is a click
_CLOSE_PX = 9.0  # at 1×: a click so near to a polygon's first corner closes it

Held = tuple[Gesture | None, Workspace]


def mode(wanted: str) -> str:
    """What is done with what was selected before: Shift adds, Ctrl takes away, both keep what is in both."""
    io = imgui.get_io()
    if io.key_shift:
        return "intersect" if io.key_ctrl else "add"
    return "subtract" if io.key_ctrl else wanted


def press(gesture: Gesture | None, work: Workspace, pointer: PointerContext) -> Held:
    """The left button went down over the picture."""
    view, tool = work.view, work.view.select
    at = pointer.cursor
    if gesture is not None and gesture.tool == "polygon" == tool.tool:
        if imgui.is_mouse_double_clicked(0) or _is_near(gesture, pointer):
            return finish(gesture, work, pointer)
        return replace(gesture, path=(*gesture.path, at)), work
    begun_at = begin(tool.tool, mode(tool.mode), view.selection.members, at, pointer.surface, tool.through)
    return (None, work) if begun_at is None else follow(begun_at, work, pointer)


def click(work: Workspace, pointer: PointerContext) -> tuple[Click, Workspace]:
    """The left button went down over the picture, with a tool that needs no more than that."""
    tool, before = work.view.select, work.view.selection.members
    made = Click(
        tool.tool, mode(tool.mode), before, pointer.cursor, pointer.surface, (0.0, False), before, before
    )
    made, work = _click(made, work, pointer)
    return replace(made, recorded=made.after), work


def adjust(click: Click | None, work: Workspace, pointer: PointerContext) -> tuple[Click | None, Workspace]:
    """The last click again where its tolerance or depth is another, as one change for undo.

    None where something else was selected since, or the tool is another.
    """
    tool = work.view.select
    if click is None or (tool.tool, work.view.selection.members) != (click.tool, click.after):
        return None, work
    past = work.past
    if past.past and past.present.edit.selection.members == click.after != click.recorded:
        if past.past[-1].edit.selection.members == click.recorded != click.before:
            work = replace(work, past=history.merge(past))
        click = replace(click, recorded=click.after)
    same = click.options == (tool.tolerance, tool.through)
    return (click, work) if same else _click(click, work, pointer)


def _click(click: Click, work: Workspace, pointer: PointerContext) -> tuple[Click, Workspace]:
    """What a click selects by the tool as it is now."""
    options = work.view.select.tolerance, work.view.select.through
    found = clicked(click.tool, click.at, click.surface, *options, pointer.facts.neighborhood)
    if found is not None:
        work = _apply(click, work, found, pointer)
    return replace(click, options=options, after=work.view.selection.members), work


def follow(gesture: Gesture, work: Workspace, pointer: PointerContext) -> Held:
    """The mouse is elsewhere with the button down; brush and sphere select at once."""
    if gesture.tool == "polygon":
        return gesture, work
    density = imgui.get_io().display_framebuffer_scale.x * pointer.ui.scale
    gesture = extend(gesture, pointer.cursor, work.view.select.radius * density)
    if gesture.tool in ("brush", "sphere"):
        work = _apply(gesture, work, _enclosed(gesture, work, pointer), pointer)
    return gesture, work


def release(gesture: Gesture, work: Workspace, pointer: PointerContext) -> Held:
    """The left button went up; a polygon waits for its next corner."""
    return (gesture, work) if gesture.tool == "polygon" else finish(gesture, work, pointer)


def finish(gesture: Gesture, work: Workspace, pointer: PointerContext) -> Held:
    """The gesture is over. A click in place of a shape selects nothing, and adds or takes away nothing."""
    if gesture.tool not in ("box", "lasso", "polygon"):
        return None, work
    low, high = map(min, zip(*gesture.path, strict=True)), map(max, zip(*gesture.path, strict=True))
    small = max(b - a for a, b in zip(low, high, strict=True)) <= _TRAVEL_PX * pointer.ui.scale
    if not small:
        return None, _apply(gesture, work, _enclosed(gesture, work, pointer), pointer)
    return None, _with(work, selection.select_none(work.view.selection)) if gesture.mode == "new" else work


def take_keys(
    gesture: Gesture | None, work: Workspace, pointer: PointerContext, keys: Keys
) -> tuple[Gesture | None, Workspace, Keys]:
    """A polygon under way takes Enter, which closes it, and Escape, which drops it; others go on."""
    pressed = [press.chord for press in keys.pressed]
    if gesture is None or gesture.tool != "polygon" or imgui.get_io().want_text_input:
        return gesture, work, keys
    if work.view.select.tool != "polygon":
        return None, work, keys
    if "Enter" in pressed:
        gesture, work = finish(gesture, work, pointer)
    elif "Escape" in pressed:
        gesture = None
    left = tuple(press for press in keys.pressed if press.chord not in ("Enter", "Escape"))
    return gesture, work, replace(keys, pressed=left)


def _is_near(gesture: Gesture, pointer: PointerContext) -> bool:
    """Whether the cursor is on the first corner of a polygon."""
    (x, y), (cx, cy) = gesture.path[0], pointer.cursor
    reach = _CLOSE_PX * pointer.ui.scale * imgui.get_io().display_framebuffer_scale.x
    return len(gesture.path) > 2 and (x - cx) ** 2 + (y - cy) ** 2 <= reach * reach


def _enclosed(gesture: Gesture, work: Workspace, pointer: PointerContext) -> Mask:
    return enclosed(gesture, pointer.surface, work.view.select.through)


def _apply(gesture: Gesture | Click, work: Workspace, found: Mask, pointer: PointerContext) -> Workspace:
    before = unpack(gesture.before, pointer.facts.count)
    return _with(work, selection.select(work.view.selection, combine(before, found, gesture.mode)))


def _with(work: Workspace, state: selection.SelectionState) -> Workspace:
    return replace(work, view=replace(work.view, selection=state))
