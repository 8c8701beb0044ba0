"""Selection tools in the picture: mouse gestures, their selected Gaussians, and their drawing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from imgui_bundle import imgui
from torch import Tensor

from progdf.color.edits import hex_color
from progdf.color.oklab import oklab_to_srgb
from progdf.quaternions import rotation_matrices, turn_quats
from progdf.scene.neighbors import Neighborhood, grow_along_surface
from progdf.scene.scribbles import Rows
from progdf.scene.selection import (
    Mask,
    Surface,
    alike_in_color,
    base_colors,
    combine,
    front_surface,
    inside_ball,
    inside_polygon,
    inside_rectangle,
    inside_stroke,
    main_rows,
    pixel_color,
    project_centers,
)
from progdf.scene.subject import select_subject
from viewer.camera.view_camera import Vec3
from viewer.render.picking import seen_at, surface_point
from viewer.state import history, selection
from viewer.state.forms import with_color
from viewer.state.transient import Brushed, Click, Gesture, MouseTool, Point, Strokes
from viewer.state.view_state import ViewState
from viewer.state.workspace import Workspace, original, with_tool, with_transient
from viewer.ui.context import PALETTE, UiContext, u32
from viewer.ui.keys import Keys
from viewer.ui.pointer import PointerContext

_STROKE_PX = 4.0  # at 1×: half a stroke's width
_MAX_PLACES = 16  # sampled positions


def begin(tool: str, mode: str, before: bytes, at: Point, surface: Surface, through: bool) -> Gesture | None:
    """Return the gesture that starts at the pressed position; None for a sphere on the background.

    Args:
        surface: surface of the scene on screen
        through: also select occluded Gaussians
    """
    gesture = Gesture(tool, mode, before, (at,))
    if tool in ("brush", "scribble"):
        front = np.isfinite(surface.centers.points[:, 0])
        if not through:
            front = surface.front(np.arange(len(front)))
        return replace(gesture, brushed=Brushed(surface.centers, front, np.zeros(len(front), bool)))
    if tool == "sphere":
        camera = surface.camera
        center = surface_point(surface.scene, surface.camera, *at)
        if center is None:
            return None
        depth = float(camera.viewmat[2, :3] @ torch.tensor(center, dtype=camera.viewmat.dtype))
        scale = (depth + float(camera.viewmat[2, 3])) / float(camera.K[0, 0])
        return replace(gesture, center=center, scale=scale)
    return gesture


def extend(gesture: Gesture, at: Point, radius: float) -> Gesture:
    """Return the gesture after a move of the pointer, an equal one if nothing changes.

    Args:
        radius: radius of a brush, pixels of the picture
    """
    if gesture.tool in ("box", "sphere"):
        return replace(gesture, path=(gesture.path[0], at))
    if gesture.brushed is not None:
        brushed = gesture.brushed
        touched = inside_stroke(brushed.centers.points, (gesture.path[-1], at), radius) & brushed.reachable
        if (touched & ~brushed.touched).any():
            gesture = replace(gesture, brushed=replace(brushed, touched=brushed.touched | touched))
    return gesture if at == gesture.path[-1] else replace(gesture, path=(*gesture.path, at))


def rows_inside(gesture: Gesture, surface: Surface, through: bool) -> Mask:
    """Return the Gaussians that the gesture selects now. Arguments as in `begin`. [N]"""
    if gesture.brushed is not None:
        return gesture.brushed.touched
    if gesture.center is not None:
        return inside_ball(surface.scene, gesture.center, gesture.radius)
    points = surface.centers.points
    if gesture.tool == "box":
        mask = inside_rectangle(points, gesture.path[0], gesture.path[-1])
    else:
        mask = inside_polygon(points, gesture.path)
    return mask if through else surface.in_front(mask)


def pick_color(work: Workspace, pointer: PointerContext) -> Workspace:
    """Add the original's color under the mouse to the palette of the form."""
    scene = pointer.engine.gaussians(original(pointer.shown))
    seen = seen_at(scene, pointer.camera(pointer.shown.camera), *pointer.cursor)
    if seen is None:
        return replace(work, form=replace(work.form, picks=False))
    colors = base_colors(scene[torch.from_numpy(seen.rows)])
    color = oklab_to_srgb(torch.from_numpy(np.average(colors, axis=0, weights=seen.shares))).tolist()
    return replace(work, form=with_color(work.form, hex_color(color)))


def rows_at_click(
    tool: str,
    at: Point,
    surface: Surface,
    tolerance: float,
    through: bool,
    neighborhood: Callable[[], Neighborhood],
) -> Mask | None:
    """Return the Gaussians that "flood" or "color" selects; None on the background. Arguments as in `begin`.
    [N]"""
    seen = seen_at(surface.scene, surface.camera, *at)
    if seen is None:
        return None
    colors = surface.colors
    color = pixel_color(surface.scene, surface.camera, *at)
    seeds = main_rows(seen.rows, seen.shares)
    if tool == "flood":
        return grow_along_surface(neighborhood(), colors, seeds, color, tolerance)
    mask = alike_in_color(colors, color, tolerance)
    mask[seeds] = True
    return mask if through else surface.in_front(mask)


SELECT_DRAG = "select"
"""Name of the left drag while a selection tool is active, in addition to those of `keys.DRAGS`."""

_TRAVEL_PX = 3.0  # at 1×: a press that moves no further is a click
_CLOSE_PX = 9.0  # at 1×: a click within this distance of a polygon's first corner closes it


def mode(chosen: str) -> str:
    """Return the mode that combines with the old selection: Shift adds, Ctrl subtracts, both intersect."""
    io = imgui.get_io()
    if io.key_shift:
        return "intersect" if io.key_ctrl else "add"
    return "subtract" if io.key_ctrl else chosen


def press(work: Workspace, pointer: PointerContext) -> Workspace:
    """Handle a press of the left button over the picture."""
    view = work.view
    tool = work.view.select
    gesture = work.transient.tool.gesture
    at = pointer.cursor
    if gesture is not None and gesture.tool == "polygon" == tool.tool:
        if imgui.is_mouse_double_clicked(0) or _is_near(gesture, pointer):
            return finish(gesture, work, pointer)
        return with_tool(work, gesture=replace(gesture, path=(*gesture.path, at)))
    begun_at = begin(tool.tool, mode(tool.mode), view.selection.members, at, pointer.surface, tool.through)
    return with_tool(work, gesture=None) if begun_at is None else follow(begun_at, work, pointer)


CLICKED = ("flood", "color", "polygon")
"""Tools that need only clicks."""


def click(work: Workspace, pointer: PointerContext) -> Workspace:
    """Select similar Gaussians at a click of the left button over the picture."""
    tool = work.view.select
    before = work.view.selection.members
    new_click = Click(
        tool.tool, mode(tool.mode), before, pointer.cursor, pointer.surface, (0.0, False), before, before
    )
    new_click, work = _click(new_click, work, pointer)
    new_click = replace(new_click, recorded=new_click.after)
    return with_transient(work, tool=MouseTool(SELECT_DRAG, click=new_click))


def adjust(work: Workspace, pointer: PointerContext) -> Workspace:
    """Repeat the last click if its tolerance or depth has changed, merged into one change for undo.

    Drop the click if the tool or the selection has changed since.
    """
    tool = work.view.select
    click = work.transient.tool.click
    if click is None or (tool.tool, work.view.selection.members) != (click.tool, click.after):
        return with_tool(work, click=None)
    past = work.past
    if past.past and past.present.edit.selection.members == click.after != click.recorded:
        if past.past[-1].edit.selection.members == click.recorded != click.before:
            work = replace(work, past=history.merge(past))
        click = replace(click, recorded=click.after)
    if click.options != (tool.tolerance, tool.through):
        click, work = _click(click, work, pointer)
    return with_tool(work, click=click)


def _click(click: Click, work: Workspace, pointer: PointerContext) -> tuple[Click, Workspace]:
    """Select by a click with the tool's current options."""
    options = work.view.select.tolerance, work.view.select.through
    mask = rows_at_click(click.tool, click.at, click.surface, *options, pointer.facts.neighborhood)
    if mask is not None:
        work = _apply(click, work, mask, pointer)
    return replace(click, options=options, after=work.view.selection.members), work


def follow(gesture: Gesture, work: Workspace, pointer: PointerContext) -> Workspace:
    """Extend the gesture while the button is down; brush and sphere select at once."""
    if gesture.tool == "polygon":
        return with_tool(work, gesture=gesture)
    density = imgui.get_io().display_framebuffer_scale.x * pointer.ui.scale
    radius = _STROKE_PX if gesture.tool == "scribble" else work.view.select.radius
    gesture = extend(gesture, pointer.cursor, radius * density)
    if gesture.tool in ("brush", "sphere"):
        work = _apply(gesture, work, _selected_rows(gesture, work, pointer), pointer)
    return with_tool(work, gesture=gesture)


def release(gesture: Gesture, work: Workspace, pointer: PointerContext) -> Workspace:
    """Handle the release of the left button; a polygon waits for its next corner."""
    if gesture.tool == "polygon":
        return work
    if gesture.tool == "scribble":
        work = spread(gesture, work, pointer)
    return finish(gesture, work, pointer)


def finish(gesture: Gesture, work: Workspace, pointer: PointerContext) -> Workspace:
    """Finish the gesture. A click in place of a shape deselects in mode "new" and changes nothing in the
    others."""
    work = with_tool(work, gesture=None)
    if gesture.tool not in ("box", "lasso", "polygon"):
        return work
    low = map(min, zip(*gesture.path, strict=True))
    high = map(max, zip(*gesture.path, strict=True))
    small = max(b - a for a, b in zip(low, high, strict=True)) <= _TRAVEL_PX * pointer.ui.scale
    if not small:
        return _apply(gesture, work, _selected_rows(gesture, work, pointer), pointer)
    return _with(work, selection.select_none(work.view.selection)) if gesture.mode == "new" else work


def find_subject(surface: Surface, neighborhood: Callable[[], Neighborhood], up: Vec3) -> Mask:
    """Return the object in the middle of a picture. [N]

    Args:
        surface: surface of the scene on screen, which must not change meanwhile
        neighborhood: returns the neighborhood of its Gaussians, computed on first use
        up: up axis of the view

    Raises:
        ProgdfError: see `select_subject`.
    """
    return select_subject(surface.scene, neighborhood(), surface.camera, torch.tensor(up))


def spread(gesture: Gesture, work: Workspace, pointer: PointerContext) -> Workspace:
    """Finish a scribble: select the Gaussians closer to the strokes on the object than to those next to it.

    Strokes count until something else is selected, and again if undo restores their selection.
    """
    last = last_strokes(work)
    on = np.zeros(0, np.int64) if last is None else last.on
    beside = np.zeros(0, np.int64) if last is None else last.beside
    seen = pointer.surface.in_front(np.ones(pointer.facts.count, bool))
    if last is not None:
        seen = seen | selection.unpack(last.seen, pointer.facts.count)
    touched = np.zeros(0, np.int64) if gesture.brushed is None else np.flatnonzero(gesture.brushed.touched)
    path = gesture.path[:: len(gesture.path) // _MAX_PLACES + 1]
    places = (seen_at(pointer.surface.scene, pointer.surface.camera, *at) for at in path)
    # large Gaussians are visible where their centers are not
    rows = np.concatenate(
        [touched, *(main_rows(place.rows, place.shares) for place in places if place is not None)]
    )
    if gesture.mode == "subtract":
        beside = np.union1d(beside, rows)
    else:
        on = np.union1d(on, rows)
    mask = np.zeros(pointer.facts.count, bool)
    mask[on] = True  # the only known Gaussians before a stroke next to the object
    guessed = np.zeros_like(mask)
    if len(on) and len(beside):
        mask = pointer.facts.scribbles().select(on, beside)
        guessed = _on_other_sides(pointer.surface, mask, torch.tensor(work.view.camera.up)) & ~seen
    mask = mask | pointer.facts.paint_on(work.view, mask)
    work = _with(work, selection.select(work.view.selection, mask))
    after = work.view.selection.members
    strokes = Strokes(on, beside, after, selection.pack(seen), selection.pack(guessed))
    return with_tool(work, strokes=(*work.transient.tool.strokes, strokes))


def _on_other_sides(surface: Surface, mask: Mask, up: Tensor) -> Mask:
    """Return the selected Gaussians on the front surface of the selection alone from its left, back or right.

    Args:
        surface: the visible surface
        mask: the selection. [N]
        up: world direction that is up. [3]
    """
    rows = np.flatnonzero(mask)
    result = np.zeros_like(mask)
    if not len(rows):
        return result
    part = surface.scene[torch.from_numpy(rows)]
    center = part.means.median(dim=0).values
    for angle in (0.5 * math.pi, math.pi, 1.5 * math.pi):
        turn = rotation_matrices(turn_quats(angle * up[None]))[0]
        pose = torch.eye(4)
        pose[:3, :3] = turn
        pose[:3, 3] = center - turn @ center
        camera = replace(surface.camera, viewmat=surface.camera.viewmat @ pose)
        result[rows] |= front_surface(part, camera, project_centers(part, camera))
    return result


def last_strokes(work: Workspace) -> Strokes | None:
    """Return the strokes that led to the selection, or None."""
    strokes = reversed(work.transient.tool.strokes)
    return next((each for each in strokes if each.after == work.view.selection.members), None)


def strokes_of(work: Workspace) -> tuple[Rows, Rows] | None:
    """Return the rows, on the object and next to it, of the strokes that led to the selection, or None."""
    last = last_strokes(work)
    return None if last is None else (last.on, last.beside)


def guessed_rows(work: Workspace) -> bytes:
    """Return the selected Gaussians that were in no view with a stroke, packed, while the tool is active."""
    last = last_strokes(work) if work.view.select.tool == "scribble" else None
    return selection.EMPTY_MASK if last is None else last.guessed


def next_step(work: Workspace) -> str:
    """Return the instruction for the next stroke of a scribble, "" if none is needed.

    A stroke of the other kind is missing, or a part of the selection was not in view.
    """
    strokes = strokes_of(work)
    if work.view.select.tool != "scribble" or strokes is None:
        return ""
    on, beside = strokes
    if len(on) and not len(beside):
        return "Now stroke the background (Ctrl)"
    if len(beside) and not len(on):
        return "Now stroke the object"
    if guessed_rows(work) != selection.EMPTY_MASK:
        return "Blue is a guess: turn and stroke there"
    return ""


def take_keys(work: Workspace, pointer: PointerContext, keys: Keys) -> tuple[Workspace, Keys]:
    """Handle Enter, which closes a polygon in progress, and Escape, which drops it; return unused keys."""
    pressed = [press.chord for press in keys.pressed]
    gesture = work.transient.tool.gesture
    if gesture is None or gesture.tool != "polygon" or imgui.get_io().want_text_input:
        return work, keys
    if work.view.select.tool != "polygon":
        return with_tool(work, gesture=None), keys
    if "Enter" in pressed:
        work = finish(gesture, work, pointer)
    elif "Escape" in pressed:
        work = with_tool(work, gesture=None)
    unused = tuple(press for press in keys.pressed if press.chord not in ("Enter", "Escape"))
    return work, replace(keys, pressed=unused)


def _is_near(gesture: Gesture, pointer: PointerContext) -> bool:
    """Return True if the cursor is on the first corner of a polygon."""
    (x, y), (cx, cy) = gesture.path[0], pointer.cursor
    reach = _CLOSE_PX * pointer.ui.scale * imgui.get_io().display_framebuffer_scale.x
    return len(gesture.path) > 2 and (x - cx) ** 2 + (y - cy) ** 2 <= reach * reach


def _selected_rows(gesture: Gesture, work: Workspace, pointer: PointerContext) -> Mask:
    return rows_inside(gesture, pointer.surface, work.view.select.through)


def _apply(gesture: Gesture | Click, work: Workspace, mask: Mask, pointer: PointerContext) -> Workspace:
    before = selection.unpack(gesture.before, pointer.facts.count)
    mask = mask | pointer.facts.paint_on(work.view, mask)
    return _with(work, selection.select(work.view.selection, combine(before, mask, gesture.mode)))


def _with(work: Workspace, state: selection.SelectionState) -> Workspace:
    return replace(work, view=replace(work.view, selection=state))


# widths at 1×
_HALO = 3.0
_LINE = 1.25


def draw_strokes(work: Workspace, pointer: PointerContext) -> None:
    """Draw the strokes as dots on the visible surface, green on the object and red next to it.

    They are not drawn under a preview or another image, or while the picture moves.
    """
    rows = strokes_of(work) if work.view.select.tool == "scribble" else None
    moves = work.transient.tool.drag is not None or work.glide is not None
    if rows is None or moves or work.transient.cover is not None:
        return
    density = imgui.get_io().display_framebuffer_scale
    canvas = imgui.get_background_draw_list()
    for at, color in zip(pointer.visible_dots(rows), (_ON_COLOR, _BESIDE_COLOR), strict=True):
        for x, y in at.tolist():
            center = ((x + pointer.left) / density.x, y / density.y)
            canvas.add_circle_filled(center, 2.0 * pointer.ui.scale, u32(color))


def draw_gesture(gesture: Gesture | None, view: ViewState, ui: UiContext, left: int = 0) -> None:
    """Draw the gesture in window coordinates; the ring of the brush also between its strokes.

    Args:
        left: first column of the picture, framebuffer pixels
    """
    io = imgui.get_io()
    mouse = imgui.get_mouse_pos()
    over = not io.want_capture_mouse
    if view.select.tool == "brush" and over:
        _circle(mouse, view.select.radius * ui.scale, ui)
    if gesture is None:
        return
    density = io.display_framebuffer_scale
    path = [imgui.ImVec2((x + left) / density.x, y / density.y) for x, y in gesture.path]
    first = path[0]
    last = path[-1]
    if gesture.tool == "box":
        corners = ((last.x, first.y), last, (first.x, last.y))
        _line([first, *corners], True, ui)
    elif gesture.tool == "lasso":
        _line(path, True, ui)
    elif gesture.tool == "scribble":
        canvas = imgui.get_background_draw_list()
        color = _BESIDE_COLOR if gesture.mode == "subtract" else _ON_COLOR
        canvas.add_polyline([*path], u32(color), 2 * _STROKE_PX * ui.scale, 0)
    elif gesture.tool == "polygon":
        _line([*path, mouse] if over else path, False, ui)
        for corner in path:
            _dot(corner, ui)
    elif gesture.tool == "sphere":
        _circle(first, ((last.x - first.x) ** 2 + (last.y - first.y) ** 2) ** 0.5, ui)
        _dot(first, ui)


def _line(path: Sequence[imgui.ImVec2Like], closed: bool, ui: UiContext) -> None:
    canvas = imgui.get_background_draw_list()
    flags = imgui.ImDrawFlags_.closed.value if closed else 0
    for color, width in ((_OUTLINE_COLOR, _HALO), (PALETTE.handle, _LINE)):
        canvas.add_polyline([*path], u32(color), width * ui.scale, flags)


def _circle(center: imgui.ImVec2Like, radius: float, ui: UiContext) -> None:
    canvas = imgui.get_background_draw_list()
    for color, width in ((_OUTLINE_COLOR, _HALO), (PALETTE.handle, _LINE)):
        canvas.add_circle(center, radius, u32(color), 0, width * ui.scale)


def _dot(center: imgui.ImVec2Like, ui: UiContext) -> None:
    canvas = imgui.get_background_draw_list()
    for color, radius in ((_OUTLINE_COLOR, 4.5), (PALETTE.handle, 3.0)):
        canvas.add_circle_filled(center, radius * ui.scale, u32(color))


_OUTLINE_COLOR = (0.0, 0.0, 0.0, 0.5)
_ON_COLOR = (0.30, 0.85, 0.35, 1.0)
_BESIDE_COLOR = (0.95, 0.30, 0.25, 1.0)
