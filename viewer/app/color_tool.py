"""Color brush and clone stamp: strokes on the picture, the picked color or source, and their drawing."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray

from progdf.painting.strokes import (
    BrushTip,
    Floats,
    Pixels,
    Point,
    begin_stroke,
    composite_over_picture,
    extend_stroke,
)
from viewer.camera.view_camera import to_camera
from viewer.panel import tools
from viewer.pictures.film import to_pixels
from viewer.render.paint_overlay import (
    erase_under,
    is_in_view,
    packed_picture,
    paint_in_view,
    pixels_of,
)
from viewer.render.picking import surface_point
from viewer.state.transient import CloneSource, ColorDrag, MouseTool
from viewer.state.view_state import MAX_PAINTED, PaintedPicture
from viewer.state.workspace import Workspace, with_message, with_tool, with_transient
from viewer.ui.context import PALETTE, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.pointer import PointerContext

_Number = TypeVar("_Number", np.uint8, np.float32)

COLOR_DRAG = "color"
"""Name of the left drag while the color brush or the clone stamp is active, in addition to `keys.DRAGS`."""

_CROSS_PX = 7.0  # at 1×: arm of the cross at the source of the clone stamp


def obstacle(work: Workspace, pointer: PointerContext) -> str:
    """Return the reason why a stroke cannot begin here, in one line; "" if it can."""
    view = work.view
    if view.compare.mode != "off":
        return f"two pictures are compared; end this with {shortcut(view.compare.mode) or 'Esc'}"
    if work.before:
        return f"the original is shown; press {shortcut('before')}"
    camera = pointer.shown.camera
    is_new = not any(is_in_view(one, camera, pointer.size) for one in view.painted)
    if is_new and len(view.painted) >= MAX_PAINTED:
        return f"{MAX_PAINTED} views are painted; press Done painting first"
    brush = view.color_brush
    if brush.tool == "clone" and not brush.erases and work.transient.clone is None:
        return "the clone stamp has no source; Alt+click the place to copy from"
    return "" if brush.erases else pointer.unpaintable_at_cursor()


def press(work: Workspace, pointer: PointerContext) -> Workspace:
    """Begin a stroke at the cursor, or show the reason why it is not possible."""
    reason = obstacle(work, pointer)
    if reason:
        return with_message(work, f"Cannot paint: {reason}", pointer.now, error=True)
    pointer.paint.fits.stop()
    view = work.view
    camera = pointer.shown.camera
    surface = pointer.view_surface(camera, pointer.size)
    own = next((one for one in view.painted if is_in_view(one, camera, pointer.size)), None)
    before = np.zeros((pointer.size[1], pointer.size[0], 4), np.uint8) if own is None else pixels_of(own)
    reachable = surface.opacity
    colors: Floats | None = np.array(view.color_brush.color, np.float32)
    if view.color_brush.erases:
        colors = None
    elif view.color_brush.tool == "clone":
        work, offset = _clone_offset(work, pointer)
        if offset is None:
            text = "Cannot paint: the source of the clone stamp is not in this view; Alt+click a new one"
            return with_message(work, text, pointer.now, error=True)
        copied = shift_picture(picture_with_paint(work, pointer), offset)
        colors = copied.astype(np.float32) / np.float32(255.0)
        # the background of the source is not copied
        reachable = reachable * shift_picture(surface.opacity, offset)
    stroke = begin_stroke(before, reachable, colors)
    drag = ColorDrag(stroke, camera, pointer.size, surface)
    return follow(with_transient(work, tool=MouseTool(COLOR_DRAG, coloring=drag)), pointer)


def follow(work: Workspace, pointer: PointerContext) -> Workspace:
    """Extend the stroke to the cursor."""
    drag = work.transient.tool.coloring
    if drag is None:
        return work
    brush = work.view.color_brush
    density = imgui.get_io().display_framebuffer_scale.x * pointer.ui.scale
    tip = BrushTip(brush.radius * density, brush.hardness, brush.flow)
    stroke = extend_stroke(drag.stroke, *pointer.cursor, tip)
    return with_tool(work, coloring=replace(drag, stroke=stroke))


def release(work: Workspace, pointer: PointerContext) -> Workspace:
    """Finish the stroke: it becomes part of the painted picture of its view.

    Paint of other views below it is erased, so that a place has one color from all sides.
    """
    drag = work.transient.tool.coloring
    work = with_tool(work, coloring=None)
    if drag is None:
        return work
    stroke = drag.stroke
    if not stroke.coverage.any():
        text = "Nothing was painted: there is no surface under the brush"
        return with_message(work, text, pointer.now, error=True)
    painted = list[PaintedPicture]()
    for picture in work.view.painted:
        if not is_in_view(picture, drag.camera, drag.size):
            under = pointer.paint_surface(picture)
            left = erase_under(picture, stroke.coverage, drag.surface, under)
            painted += [left] if _has_paint(left) else []
    own = packed_picture(drag.camera, drag.size, stroke.pixels)
    painted += [own] if _has_paint(own) else []
    return replace(work, view=replace(work.view, painted=tuple(painted)))


def _has_paint(picture: PaintedPicture) -> bool:
    left, top, right, bottom = picture.box
    return left < right and top < bottom


def pick(work: Workspace, pointer: PointerContext) -> Workspace:
    """Take the color under the cursor, or set the source of the clone stamp there."""
    camera = pointer.camera(pointer.shown.camera)
    if work.view.color_brush.tool == "clone":
        point = surface_point(pointer.scene, camera, *pointer.cursor, pointer.engine.near)
        if point is None:
            text = "There is no surface to copy from; Alt+click a place on the scene"
            return with_message(work, text, pointer.now, error=True)
        return with_transient(work, clone=CloneSource(point))
    picture = picture_with_paint(work, pointer)
    x = min(max(int(pointer.cursor[0]), 0), picture.shape[1] - 1)
    y = min(max(int(pointer.cursor[1]), 0), picture.shape[0] - 1)
    red, green, blue = (float(channel) / 255.0 for channel in picture[y, x])
    brush = replace(work.view.color_brush, color=(red, green, blue), erases=False)
    return replace(work, view=replace(work.view, color_brush=brush))


def picture_with_paint(work: Workspace, pointer: PointerContext) -> Pixels:
    """Return the picture on screen with all paint. [H,W,3]"""
    camera = pointer.shown.camera
    picture = to_pixels(pointer.engine.image(pointer.shown, pointer.size))
    if not work.view.painted:
        return picture
    visible = pointer.view_surface(camera, pointer.size)
    above = paint_in_view(work.view.painted, camera, pointer.size, pointer.paint_surface, visible)
    return composite_over_picture(picture, above)


def _clone_offset(work: Workspace, pointer: PointerContext) -> tuple[Workspace, Point | None]:
    """Return the distance from the stroke to the source in pixels; None if the source is not in the picture.

    It stays the same for all strokes in one view, so that they join.
    """
    source = work.transient.clone
    if source is None:
        return work, None
    view_camera = pointer.shown.camera
    if source.offset is None or source.camera != view_camera:
        at = _project(source, pointer)
        if at is None:
            return work, None
        x, y = pointer.cursor
        offset = (float(round(at[0] - x)), float(round(at[1] - y)))
        source = replace(source, offset=offset, camera=view_camera)
    return with_transient(work, clone=source), source.offset


def _project(source: CloneSource, pointer: PointerContext) -> Point | None:
    """Return the place of the source in the picture, pixels; None if it is outside."""
    camera = to_camera(pointer.shown.camera, *pointer.size)
    viewmat = camera.viewmat.double().numpy()
    K = camera.K.double().numpy()
    x, y, z = viewmat[:3, :3] @ np.array(source.point) + viewmat[:3, 3]
    if z <= pointer.engine.near:
        return None
    at = float(x / z * K[0, 0] + K[0, 2]), float(y / z * K[1, 1] + K[1, 2])
    return at if 0.0 <= at[0] < camera.width and 0.0 <= at[1] < camera.height else None


def shift_picture(values: NDArray[_Number], offset: Point) -> NDArray[_Number]:
    """Return the value at an offset (x, y) from each pixel, pixels; 0 outside the picture. [H,W,…]"""
    height, width = values.shape[:2]
    rows = np.arange(height) + int(offset[1])
    columns = np.arange(width) + int(offset[0])
    in_rows = (rows >= 0) & (rows < height)
    in_columns = (columns >= 0) & (columns < width)
    result = np.zeros_like(values)
    result[np.ix_(in_rows, in_columns)] = values[np.ix_(rows[in_rows], columns[in_columns])]
    return result


def draw(work: Workspace, pointer: PointerContext) -> None:
    """Draw all paint over the picture; a comparison and the original are shown without it."""
    pending = tuple(picture for paint in work.transient.pending for picture in paint.painted)
    drag = work.transient.tool.coloring
    painted = (*pending, *work.view.painted)
    if work.view.compare.mode != "off" or work.before or not (painted or drag):
        return
    camera = pointer.shown.camera
    held = imgui.is_any_item_active() or (work.transient.tool.drag is not None and drag is None)
    moves = held or work.glide is not None or work.player.playing
    visible = pointer.known_surface(camera, pointer.size, request=not moves)
    surface_of = pointer.recent_surface if moves else pointer.paint_surface
    texture = pointer.paint.texture(
        painted, drag, camera, pointer.size, (pointer.scene_key, moves), surface_of, visible
    )
    corners = (0.0, 0.0), (pointer.area.width, pointer.area.height)
    imgui.get_background_draw_list().add_image(imgui.ImTextureRef(texture), *corners)


def draw_tip(work: Workspace, pointer: PointerContext) -> None:
    """Draw the brush at the cursor and the source of the clone stamp."""
    io = imgui.get_io()
    brush = work.view.color_brush
    if not io.want_capture_mouse and not io.key_alt:
        tools.draw_circles(brush.radius, brush.hardness, pointer.ui)
    source = work.transient.clone
    if brush.tool != "clone" or brush.erases or source is None:
        return
    density = io.display_framebuffer_scale
    if work.transient.tool.coloring is not None and source.offset is not None:
        x = pointer.cursor[0] + source.offset[0]
        y = pointer.cursor[1] + source.offset[1]
    else:
        at = _project(source, pointer)
        if at is None:
            return
        x, y = at
    _draw_cross(x / density.x, y / density.y, pointer.ui)


def _draw_cross(x: float, y: float, ui: UiContext) -> None:
    canvas = imgui.get_background_draw_list()
    arm = _CROSS_PX * ui.scale
    for color, width in (((0.0, 0.0, 0.0, 0.6), 3.5), (PALETTE.handle, 1.5)):
        canvas.add_line((x - arm, y), (x + arm, y), u32(color), width * ui.scale)
        canvas.add_line((x, y - arm), (x, y + arm), u32(color), width * ui.scale)
