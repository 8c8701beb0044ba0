"""Placement of a decal: it follows the pointer on the surface; after a click, handles change it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from imgui_bundle import imgui

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.surface.footprint import DepthPicture, fit_footprint
from viewer.camera.decal_warp import (
    DecalFrame,
    DecalMesh,
    Floats,
    decal_camera,
    plane_points,
    project,
    upright_on,
    vec3,
    visible_cells,
    warp_on_footprint,
)
from viewer.camera.view_camera import axes
from viewer.render.decal_surfaces import DecalSurfaces, unhidden_frame
from viewer.state.transient import Decal, DecalGhost, DecalGrip, Transient
from viewer.state.workspace import Workspace, with_transient
from viewer.ui import overlay
from viewer.ui.context import GAP_PX, PALETTE, u32
from viewer.ui.keys import Keys
from viewer.ui.pointer import PointerContext
from viewer.ui.widgets import accent_button, checkbox, plate, small, tip

_INITIAL_SIZE = 0.25  # initial longer side, as a fraction of the view's height
_STEP = 1.08  # size factor per notch of the wheel
_TURN_DEG = 5.0  # rotation per notch of the wheel
_SNAP_DEG = 15.0  # rotation steps while Ctrl is held
NO_STEP = (1.0, 0.0)
"""Step by keys that changes nothing: size factor, and turn in degrees."""
_STEPS = {
    "Ctrl+Up": (_STEP, 0.0),
    "Ctrl+Down": (1.0 / _STEP, 0.0),
    "Ctrl+Left": (1.0, _TURN_DEG),
    "Ctrl+Right": (1.0, -_TURN_DEG),
    "Ctrl+Shift+Left": (1.0, _SNAP_DEG),
    "Ctrl+Shift+Right": (1.0, -_SNAP_DEG),
}
"""Key → size factor and turn."""
_SIZE_RANGE_PX = (8.0, 8192.0)  # minimum and maximum, window pixels
_GHOST_ALPHA = 0.9  # opacity of a decal that is not trained yet
_OFF_SURFACE_ALPHA = 0.35  # opacity where there is no surface
_GRIP_PX = 5.0  # half the side of a handle, at 1×
_REACH_PX = 10.0  # at 1×: the mouse takes a handle within this distance
SURFACE_POLL_S = 0.05
"""Seconds between frames while the surface under a decal or paint is computed."""
REST_S = 0.25
"""Seconds that the pointer must rest until the training's surface is computed before the click."""
_KNOB_PX = 26.0  # distance of the knob that rotates from the upper side, at 1×

DecalPlace = tuple[Decal, Camera, str]
"""Decal, the camera that projects it, and the value of `progdf train --at`."""


def frame_delays(decal: object, is_busy: bool, now: float) -> list[float]:
    """Return the seconds until the decal being placed needs a frame; empty for none.

    Args:
        decal: the object being placed; others than a `Decal` need none
        is_busy: the surface under the decal is being computed
        now: the clock of the window, seconds
    """
    if not isinstance(decal, Decal):
        return []
    if is_busy:
        return [SURFACE_POLL_S]
    rests = decal.frame is not None and not decal.surface
    return [max(decal.laid_at + REST_S - now, 0.0)] if rests else []


def draw_decal(
    decal: Decal, pointer: PointerContext, surfaces: DecalSurfaces, enters: bool = False
) -> tuple[Decal, str]:
    """Draw the decal; return it after this frame's mouse input, and its request, "" for none.

    Args:
        decal: the decal
        pointer: the view
        surfaces: surfaces under the decal
        enters: the key that sets it on the surface was pressed
    """
    if decal.placed:
        return _draw_placed(decal, pointer, surfaces)
    moved = _follow_pointer(decal, pointer)
    picture = None if _moves_camera() else _depth(pointer, surfaces)
    moved = _lay_under_pointer(moved, pointer, picture)
    if pointer.now - moved.laid_at >= REST_S:
        moved = _on_found_surface(moved, pointer, surfaces)
    if moved.mesh is not None:
        draw_mesh(moved.texture, moved.mesh, pointer)
    else:
        _draw_flat(moved, pointer)
    overlay.banner(_hint(moved, surfaces), pointer.area, pointer.ui)
    if enters or (_is_over(pointer) and imgui.is_mouse_clicked(0)):
        moved = set_decal(moved, pointer, surfaces)
    return moved, ""


def _on_found_surface(decal: Decal, pointer: PointerContext, surfaces: DecalSurfaces) -> Decal:
    """Return the decal on the surface that training finds; unchanged while that is computed."""
    if decal.frame is None:
        return decal
    engine = pointer.engine
    found = surfaces.laid(engine.scene, decal.frame, decal.texture_size, decal.opaque, engine.near)
    if found is None or found.mesh is decal.mesh:
        return decal
    return replace(decal, mesh=found.mesh, surface=found.surface.summary())


def _set_down(decal: Decal, pointer: PointerContext) -> Decal:
    """Fix the decal on the surface, seen by a camera from which nothing hides it."""
    frame = decal.frame
    mesh = decal.mesh
    if frame is None or mesh is None:
        return decal
    scene = pointer.engine.scene
    frame = unhidden_frame(scene, frame, decal.texture_size, mesh, pointer.engine.near)
    surface = decal.surface if frame == decal.frame else ""
    return replace(decal, frame=frame, placed=True, grip="", surface=surface)


def set_decal(decal: Decal, pointer: PointerContext, surfaces: DecalSurfaces) -> Decal:
    """Return the decal set on the surface, even if the depth of the view was not computed yet."""
    camera = pointer.camera(pointer.shown.camera)
    picture = surfaces.depth(pointer.engine.scene, camera, at_once=True)
    return _set_down(_lay_under_pointer(decal, pointer, picture), pointer)


def place_decal(decal: Decal) -> tuple[Camera, str]:
    """Return the camera that projects the decal, and the value of `progdf train --at`.

    Raises:
        ProgdfError: the decal lies on no surface.
    """
    if decal.frame is None:
        raise ProgdfError("there is no surface under the decal; move it onto the scene")
    return decal_camera(decal.frame, decal.texture_size)


def decal_takes_mouse(decal: Decal, pointer: PointerContext) -> bool:
    """Return True if the decal takes the mouse: while it follows the pointer, unless a button moves the
    camera; later only where its handles are."""
    if not decal.placed:
        return not _moves_camera()
    return bool(decal.grip) or (_is_over(pointer) and _grip_under(decal, pointer) != "")


def draw_ghosts(transient: Transient, pointer: PointerContext) -> None:
    """Draw the decals that are being trained."""
    for ghost in transient.ghosts:
        if isinstance(ghost, DecalGhost):
            draw_mesh(ghost.texture, ghost.mesh, pointer)


def draw_mesh(texture: int, mesh: DecalMesh, pointer: PointerContext) -> None:
    """Draw the cells of a decal that face the camera."""
    pixels, cells = visible_cells(mesh, pointer.camera(pointer.shown.camera))
    places = _to_window(pixels, pointer)
    canvas = imgui.get_background_draw_list()
    reference = imgui.ImTextureRef(texture)
    ink = u32((1.0, 1.0, 1.0, _GHOST_ALPHA))
    rows, columns = cells.shape
    for row, column in np.argwhere(cells).tolist():
        a, b = places[row, column : column + 2].tolist()
        d, c = places[row + 1, column : column + 2].tolist()
        left = column / columns
        right = (column + 1) / columns
        top = row / rows
        bottom = (row + 1) / rows
        canvas.add_image_quad(
            reference,
            a,
            b,
            c,
            d,
            uv1=(left, top),
            uv2=(right, top),
            uv3=(right, bottom),
            uv4=(left, bottom),
            col=ink,
        )


def _depth(pointer: PointerContext, surfaces: DecalSurfaces) -> DepthPicture | None:
    return surfaces.depth(pointer.engine.scene, pointer.camera(pointer.shown.camera))


def _moves_camera() -> bool:
    """Return True if a button that moves the camera is down."""
    return any(imgui.is_mouse_down(button) or imgui.is_mouse_released(button) for button in (1, 2))


def _is_over(pointer: PointerContext) -> bool:
    """Return True if the mouse is over the picture and no part of the interface takes it."""
    io = imgui.get_io()
    area = pointer.area
    inside = 0.0 <= io.mouse_pos.x < area.width and 0.0 <= io.mouse_pos.y < area.height
    return inside and not io.want_capture_mouse


def _follow_pointer(decal: Decal, pointer: PointerContext) -> Decal:
    """Return the decal at the pointer, after this frame's wheel."""
    io = imgui.get_io()
    area = pointer.area
    over = _is_over(pointer)
    size = decal.size or _INITIAL_SIZE * area.height
    factor, angle = _wheel(decal.angle) if over else (1.0, decal.angle)
    key_factor, turn = decal.step
    size = min(max(size * factor * key_factor, _SIZE_RANGE_PX[0]), _SIZE_RANGE_PX[1])
    angle += turn
    at = (io.mouse_pos.x, io.mouse_pos.y) if over else decal.at or (area.width / 2, area.height / 2)
    return replace(decal, size=size, angle=angle, at=at, step=NO_STEP)


def take_keys(work: Workspace, keys: Keys) -> tuple[Workspace, Keys]:
    """Handle the keys that scale and rotate a decal; return the unused keys."""
    decal = work.transient.gizmo
    if not isinstance(decal, Decal) or imgui.get_io().want_text_input:
        return work, keys
    for press in keys.pressed:
        factor, turn = _STEPS.get(press.chord, NO_STEP)
        angle = decal.angle + decal.step[1]
        if abs(turn) == _SNAP_DEG:
            turn = _snap(angle + turn) - angle
        decal = replace(decal, step=(decal.step[0] * factor, decal.step[1] + turn))
    unused = tuple(press for press in keys.pressed if press.chord not in _STEPS)
    return with_transient(work, gizmo=decal), replace(keys, pressed=unused)


def _wheel(angle: float) -> tuple[float, float]:
    """Return the factor of the size, and the angle after this frame's wheel."""
    io = imgui.get_io()
    # some systems turn the wheel sideways with Shift
    notches = io.mouse_wheel or io.mouse_wheel_h
    if not notches:
        return 1.0, angle
    if not io.key_shift:
        return _STEP**notches, angle
    step = _SNAP_DEG if io.key_ctrl else _TURN_DEG
    turned = angle + math.copysign(step, notches)
    return 1.0, _snap(turned) if io.key_ctrl else turned


def _snap(angle: float) -> float:
    return _SNAP_DEG * round(angle / _SNAP_DEG)


def _lay_under_pointer(decal: Decal, pointer: PointerContext, picture: DepthPicture | None) -> Decal:
    """Return the decal on the surface under the pointer; unchanged if nothing has changed."""
    if picture is None or decal.at is None:
        return replace(decal, frame=None, mesh=None, laid_for=None)
    key = (picture, decal.at, decal.size, decal.angle, decal.level)
    if key == decal.laid_for:
        return decal
    density = imgui.get_io().display_framebuffer_scale.x
    column = decal.at[0] * density - pointer.left
    row = decal.at[1] * density
    frame, mesh = _lay(decal, pointer, picture, (column, row), None, decal.size * density)
    return replace(decal, frame=frame, mesh=mesh, surface="", laid_for=key, laid_at=pointer.now)


def _lay(
    decal: Decal,
    pointer: PointerContext,
    picture: DepthPicture,
    at: tuple[float, float],
    size: float | None,
    size_px: float,
) -> tuple[DecalFrame | None, DecalMesh | None]:
    """Return frame and mesh of the decal with its center on a pixel; None if it shows no surface.

    Args:
        decal: picture, angle and level of the decal
        pointer: the view
        picture: its depth picture
        at: the pixel
        size: longer side, world units; None: `size_px`
        size_px: longer side, pixels of the view
    """
    footprint = fit_footprint(picture, *at, 0.5 * size_px)
    if footprint is None:
        return None, None
    pixel = footprint.depth / float(picture.camera.K[0, 0])
    normal = vec3(footprint.normal)
    view = pointer.shown.camera
    upright = upright_on(normal, view.up, axes(view).up, decal.level)
    eye = picture.camera.position.double().numpy()
    distance = float(np.linalg.norm(footprint.center - eye))
    world_size = size_px * pixel if size is None else size
    frame = DecalFrame(vec3(footprint.center), normal, upright, world_size, decal.angle, distance, pixel)
    return frame, warp_on_footprint(frame, decal.texture_size, footprint, picture)


def _draw_flat(decal: Decal, pointer: PointerContext) -> None:
    """Draw the decal as a faint flat picture, as its surface is unknown."""
    a, b, c, d = decal_corners(decal)
    tint = u32((1.0, 1.0, 1.0, _OFF_SURFACE_ALPHA))
    canvas = imgui.get_background_draw_list()
    canvas.add_image_quad(imgui.ImTextureRef(decal.texture), a, b, c, d, col=tint)


def decal_corners(decal: Decal) -> list[tuple[float, float]]:
    """Return the corners of the flat picture in the window, clockwise from its upper left corner."""
    scale = decal.size / max(decal.texture_size)
    x0, y0 = decal.at or (0.0, 0.0)
    across, down = (scale * side / 2 for side in decal.texture_size)
    cosine = math.cos(math.radians(decal.angle))
    sine = math.sin(math.radians(decal.angle))
    return [
        (x0 + x * cosine + y * sine, y0 - x * sine + y * cosine)
        for x, y in ((-across, -down), (across, -down), (across, down), (-across, down))
    ]


def _hint(decal: Decal, surfaces: DecalSurfaces) -> str:
    """Return the banner's text while the decal follows the pointer."""
    if decal.frame is None:
        state = "Finding the surface …" if surfaces.is_busy else "No surface here"
    else:
        state = size_text(decal.frame)
    return f"{state}   Click: place. Wheel or Ctrl+↑ ↓: size. Shift+wheel or Ctrl+← →: rotate. Esc: cancel"


def size_text(frame: DecalFrame) -> str:
    """Return the decal's longer side in pixels and scene units, and its angle."""
    turned = (frame.angle + 180.0) % 360.0 - 180.0
    angle = f", {turned:+.0f}°" if round(turned) else ""
    return f"{frame.size_px:.0f} px, {frame.size:.3g} units{angle}"


def _to_window(pixels: Floats, pointer: PointerContext) -> Floats:
    """Return window positions of pixels of the picture. [...,2]"""
    density = imgui.get_io().display_framebuffer_scale
    places: Floats = (pixels + np.array([pointer.left, 0.0])) / np.array([density.x, density.y])
    return places


def outline(frame: DecalFrame, decal: Decal, pointer: PointerContext) -> tuple[Floats, Floats, Floats]:
    """Return corners (clockwise from the upper left), center and knob in the window. [4,2], [2], [2]"""
    camera = pointer.camera(pointer.shown.camera)
    points = plane_points(frame, decal.texture_size, 2)
    places = _to_window(project(points, camera)[0], pointer)
    corners = places[[0, 0, 2, 2], [0, 2, 2, 0]]
    center = places[1, 1]
    top = places[0, 1]
    away = top - center
    knob = top + away / max(float(np.linalg.norm(away)), 1e-6) * _KNOB_PX * pointer.ui.scale
    return corners, center, knob


def _grip_under(decal: Decal, pointer: PointerContext) -> DecalGrip:
    """Return the handle under the mouse."""
    if decal.frame is None:
        return ""
    corners, _, knob = outline(decal.frame, decal, pointer)
    mouse = np.array([imgui.get_io().mouse_pos.x, imgui.get_io().mouse_pos.y])
    reach = _REACH_PX * pointer.ui.scale
    if np.linalg.norm(knob - mouse) <= reach:
        return "rotate"
    if np.linalg.norm(corners - mouse, axis=1).min() <= reach:
        return "scale"
    sides = np.roll(corners, -1, axis=0) - corners
    to_mouse = mouse - corners
    turns = sides[:, 0] * to_mouse[:, 1] - sides[:, 1] * to_mouse[:, 0]
    return "move" if bool((turns >= 0).all() or (turns <= 0).all()) else ""


def _draw_placed(decal: Decal, pointer: PointerContext, surfaces: DecalSurfaces) -> tuple[Decal, str]:
    """Draw the decal with its handles and buttons; return it after this frame's mouse input."""
    moved = _drag_handles(decal, pointer, surfaces)
    frame = moved.frame
    if frame is None:
        return moved, ""
    if not moved.grip and not imgui.is_mouse_down(0):
        moved = _on_found_surface(moved, pointer, surfaces)
    if moved.mesh is not None:
        draw_mesh(moved.texture, moved.mesh, pointer)
    _draw_handles(frame, moved, pointer)
    return _draw_buttons(moved, pointer, surfaces)


def _drag_handles(decal: Decal, pointer: PointerContext, surfaces: DecalSurfaces) -> Decal:
    """Return the decal after this frame's movement of its handles."""
    if decal.frame is None:
        return decal
    over = _is_over(pointer)
    under = _grip_under(decal, pointer) if over else ""
    grip: DecalGrip = decal.grip
    if under and imgui.is_mouse_clicked(0):
        grip = under
    picture = _depth(pointer, surfaces) if under or grip else None
    frame = decal.frame
    factor, turn = decal.step
    angle = decal.angle + turn
    if decal.step != NO_STEP:
        picture = surfaces.depth(pointer.engine.scene, pointer.camera(pointer.shown.camera), at_once=True)
    if grip and not imgui.is_mouse_clicked(0):
        factor, angle = _drag(grip, decal, frame, pointer)
    elif under and not grip:
        notches, angle = _wheel(angle)
        factor *= notches
    changed = replace(frame, size=frame.size * factor, angle=angle)
    x, y = _center(frame, pointer)
    io = imgui.get_io()
    if grip == "move":
        x += io.mouse_delta.x
        y += io.mouse_delta.y
    ended = bool(grip) and not imgui.is_mouse_down(0)
    result = replace(decal, angle=angle, grip="" if ended else grip, step=NO_STEP)
    travels = grip == "move" and bool(io.mouse_delta.x or io.mouse_delta.y)
    if changed == frame and not travels:
        return _set_down(result, pointer) if ended else result
    result = replace(result, frame=changed, surface="")
    if picture is not None:
        result = _lay_again(result, changed, pointer, picture, (x, y))
    return _set_down(result, pointer) if ended else result


def _lay_again(
    decal: Decal,
    frame: DecalFrame,
    pointer: PointerContext,
    picture: DepthPicture,
    at: tuple[float, float],
) -> Decal:
    """Return the decal with its changed frame on the surface at a window position."""
    density = imgui.get_io().display_framebuffer_scale.x
    pixel = (at[0] * density - pointer.left, at[1] * density)
    depth = project(np.array(frame.center), picture.camera)[1]
    size_px = frame.size * float(picture.camera.K[0, 0]) / max(float(depth), 1e-9)
    laid, mesh = _lay(decal, pointer, picture, pixel, frame.size, size_px)
    if laid is None:
        return decal
    return replace(decal, frame=laid, mesh=mesh, surface="")


def _drag(grip: DecalGrip, decal: Decal, frame: DecalFrame, pointer: PointerContext) -> tuple[float, float]:
    """Return the factor of the size, and the angle after this frame's movement of a handle."""
    io = imgui.get_io()
    _, center, _ = outline(frame, decal, pointer)
    now = np.array([io.mouse_pos.x, io.mouse_pos.y]) - center
    before = now - np.array([io.mouse_delta.x, io.mouse_delta.y])
    if grip == "scale":
        factor = float(np.linalg.norm(now) / max(float(np.linalg.norm(before)), 1.0))
        smallest = _SIZE_RANGE_PX[0] / frame.size_px
        return max(factor, smallest), decal.angle
    if grip != "rotate":
        return 1.0, decal.angle
    if io.key_ctrl:
        return 1.0, _snap(_angle_towards(now + center, frame, pointer) or decal.angle)
    return 1.0, _angle_towards(now + center, frame, pointer) or decal.angle


def _angle_towards(place: Floats, frame: DecalFrame, pointer: PointerContext) -> float | None:
    """Return the angle at which the decal's upper side points to a window position; None if it is unknown."""
    density = imgui.get_io().display_framebuffer_scale
    camera = pointer.camera(pointer.shown.camera)
    K = camera.K.double().numpy()
    pixel = place * np.array([density.x, density.y]) - np.array([pointer.left, 0.0])
    ray = np.array([*(pixel - K[:2, 2]) / K[[0, 1], [0, 1]], 1.0]) @ camera.viewmat[:3, :3].double().numpy()
    eye = camera.position.double().numpy()
    normal = np.array(frame.normal)
    slope = float(ray @ normal)
    if abs(slope) < 1e-6:
        return None
    offset = eye + ray * (float((np.array(frame.center) - eye) @ normal) / slope) - np.array(frame.center)
    up = np.array(frame.upright)
    right = np.cross(up, normal)
    return math.degrees(math.atan2(-float(offset @ right), float(offset @ up)))


def _draw_handles(frame: DecalFrame, decal: Decal, pointer: PointerContext) -> None:
    """Draw the outline, the corners that scale, and the knob that rotates."""
    corners, _, knob = outline(frame, decal, pointer)
    canvas = imgui.get_background_draw_list()
    scale = pointer.ui.scale
    held = decal.grip or (_grip_under(decal, pointer) if _is_over(pointer) else "")
    line = u32(PALETTE.handle)
    points = [(float(x), float(y)) for x, y in corners]
    top = 0.5 * (corners[0] + corners[1])
    for color, thick in ((u32(PALETTE.scrim), 3.0 * scale), (line, 1.5 * scale)):
        for a, b in zip(points, [*points[1:], points[0]], strict=True):
            canvas.add_line(a, b, color, thick)
        canvas.add_line(tuple(top.tolist()), tuple(knob.tolist()), color, thick)
    grip = _GRIP_PX * scale
    for x, y in points:
        ink = u32(PALETTE.accent) if held == "scale" else line
        canvas.add_rect_filled((x - grip, y - grip), (x + grip, y + grip), u32(PALETTE.scrim))
        canvas.add_rect_filled((x - grip + 1, y - grip + 1), (x + grip - 1, y + grip - 1), ink)
    canvas.add_circle_filled(tuple(knob.tolist()), grip + 1, u32(PALETTE.scrim))
    canvas.add_circle_filled(tuple(knob.tolist()), grip, u32(PALETTE.accent) if held == "rotate" else line)
    cursors = {
        "move": imgui.MouseCursor_.resize_all,
        "scale": imgui.MouseCursor_.resize_nwse,
        "rotate": imgui.MouseCursor_.hand,
    }
    if held:
        imgui.set_mouse_cursor(cursors[held].value)


def _draw_buttons(decal: Decal, pointer: PointerContext, surfaces: DecalSurfaces) -> tuple[Decal, str]:
    """Draw size, level and buttons at the top of the picture; return the decal and the request."""
    frame = decal.frame
    if frame is None or pointer.shown.has_tool:  # the options of a tool take the place of the buttons
        return decal, ""
    scale = pointer.ui.scale
    at = (pointer.area.width / 2, GAP_PX * scale)
    request = ""
    with plate("placing", at, pointer.ui, (0.5, 0.0)):
        imgui.align_text_to_frame_padding()
        imgui.text(size_text(frame))
        imgui.same_line()
        level = checkbox("Level", decal.level, pointer.ui)
        tip("Count the angle from the horizontal of the scene. Hold Ctrl while rotating for steps of 15°")
        imgui.same_line()
        if accent_button("Train", (72.0 * scale, 0.0)):
            request = "lay_decal"
        tip("Make the decal a part of the scene (Enter)")
        imgui.same_line()
        if imgui.button("Cancel", (72.0 * scale, 0.0)):
            request = "put_back"
        words = f"Surface: {decal.surface}" if decal.surface else "Finding the surface …"
        small(words, PALETTE.dim, imgui.calc_text_size(words).x)
    if level != decal.level:
        decal = replace(decal, level=level, angle=0.0 if level else decal.angle)
        picture = surfaces.depth(pointer.engine.scene, pointer.camera(pointer.shown.camera), at_once=True)
        if picture is not None:
            decal = _set_down(_lay_again(decal, frame, pointer, picture, _center(frame, pointer)), pointer)
    return decal, request


def _center(frame: DecalFrame, pointer: PointerContext) -> tuple[float, float]:
    """Return the window position of a decal's center."""
    pixels, _ = project(np.array(frame.center), pointer.camera(pointer.shown.camera))
    x, y = _to_window(pixels, pointer)
    return float(x), float(y)
