"""Measure tool: two clicks on the surface give a distance. Its true length sets the unit of length."""

from __future__ import annotations

import numpy as np
from imgui_bundle import imgui

from viewer.camera.view_camera import Vec3
from viewer.render.picking import surface_point
from viewer.state.transient import Measure
from viewer.state.workspace import Workspace, with_message, with_transient
from viewer.ui.context import PALETTE, UiContext, u32
from viewer.ui.pointer import PointerContext

_DOT_PX = 4.0  # at 1×


def is_measuring(work: Workspace) -> bool:
    """Return True if clicks measure: the tool is active and no other one is."""
    view = work.view
    other = view.has_tool
    return work.transient.measure is not None and work.transient.gizmo is None and not other


def click(work: Workspace, pointer: PointerContext) -> Workspace:
    """Add the surface point under the mouse; a third one begins anew."""
    measure = work.transient.measure or Measure()
    camera = pointer.camera(pointer.shown.camera)
    point = surface_point(pointer.scene, camera, *pointer.cursor, pointer.engine.near)
    if point is None:
        return with_message(work, "There is no surface here; click on the scene", pointer.now)
    earlier = measure.points if len(measure.points) == 1 else ()
    return with_transient(work, measure=Measure((*earlier, point)))


def draw(work: Workspace, pointer: PointerContext) -> None:
    """Draw the measured points, the line between them and its length."""
    measure = work.transient.measure
    if measure is None:
        return
    places = [_window_place(point, pointer) for point in measure.points]
    canvas = imgui.get_background_draw_list()
    scale = pointer.ui.scale
    if len(places) == 2:
        a, b = places
        if a is not None and b is not None:
            canvas.add_line(a, b, u32(PALETTE.scrim), 4.0 * scale)
            canvas.add_line(a, b, u32(PALETTE.accent), 2.0 * scale)
            middle = ((a[0] + b[0]) / 2.0, (a[1] + b[1]) / 2.0)
            _label(f"{(measure.distance or 0.0) * pointer.shown.unit:.4g}", middle, pointer.ui)
    for place in places:
        if place is not None:
            canvas.add_circle_filled(place, (_DOT_PX + 1.0) * scale, u32(PALETTE.scrim))
            canvas.add_circle_filled(place, _DOT_PX * scale, u32(PALETTE.accent))


def _label(text: str, at: tuple[float, float], ui: UiContext) -> None:
    canvas = imgui.get_background_draw_list()
    size = imgui.calc_text_size(text)
    pad = 4.0 * ui.scale
    left = at[0] - size.x / 2.0
    top = at[1] - size.y - 3.0 * pad
    corner = (left - pad, top - pad)
    canvas.add_rect_filled(corner, (left + size.x + pad, top + size.y + pad), u32(PALETTE.scrim), pad)
    canvas.add_text((left, top), u32(PALETTE.text), text)


def _window_place(point: Vec3, pointer: PointerContext) -> tuple[float, float] | None:
    """Return a point of the scene in the window; None behind the camera."""
    camera = pointer.camera(pointer.shown.camera)
    viewmat = camera.viewmat.double().numpy()
    x, y, z = camera.K.double().numpy() @ (viewmat[:3, :3] @ np.array(point) + viewmat[:3, 3])
    if z <= 0.0:
        return None
    density = imgui.get_io().display_framebuffer_scale
    return (float(x / z) + pointer.left) / density.x, float(y / z) / density.y
