"""Training cameras in the picture: a frustum per camera with its photograph.

A click looks through a camera and compares the splats with its photograph until the view changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.errors import ProgdfError
from viewer.camera.photograph import Photograph, load_photograph
from viewer.camera.view_camera import Bounds, Vec3, ViewCamera, axes, from_camera
from viewer.pictures.compare import PHOTOGRAPH
from viewer.pictures.film import Pixels
from viewer.state import history, workspace
from viewer.state.transient import CameraView, Viewpoint
from viewer.state.view_state import Comparison, ViewState
from viewer.state.workspace import Workspace, with_transient
from viewer.ui.context import PALETTE, u32
from viewer.ui.pointer import PointerContext

SIZE_SHARE = 0.06  # depth of a frustum, share of the scene's radius
MAX_THUMBNAILS = 200  # number of photographs that are loaded
THUMBNAIL_PX = 160  # longer side of a photograph in a frustum, pixels
_FOLDERS = ("", "images", "input", "images_2", "images_4")
"""Folders beside the cameras that may hold the photographs."""
_ENDINGS = ("", ".jpg", ".png", ".JPG", ".jpeg", ".PNG")


def viewpoints(
    cameras: Sequence[Camera], folder: Path, base: ViewCamera, bounds: Bounds
) -> tuple[Viewpoint, ...]:
    """Return the frusta of cameras, with the photographs that are found.

    Args:
        cameras: the cameras, relative to the scene's origin
        folder: folder of their file
        base: source of the up axis and the mode of the views
        bounds: bounds of the scene
    """
    return tuple(_viewpoint(camera, folder, base, bounds) for camera in cameras)


def _viewpoint(camera: Camera, folder: Path, base: ViewCamera, bounds: Bounds) -> Viewpoint:
    depth = SIZE_SHARE * bounds.radius
    pixels = np.array(
        [[0, 0, 1], [camera.width, 0, 1], [camera.width, camera.height, 1], [0, camera.height, 1]]
    )
    rays = pixels @ np.linalg.inv(camera.K.double().numpy()).T * depth
    world = camera.c2w.double().numpy()
    corners = rays @ world[:3, :3].T + world[:3, 3]
    return Viewpoint(
        camera.name,
        from_camera(base, camera, bounds),
        _point(world[:3, 3]),
        tuple(_point(corner) for corner in corners),
        find_photograph(camera.name, folder),
        camera,
    )


def _point(values: NDArray[np.float64]) -> Vec3:
    x, y, z = (float(value) for value in values)
    return x, y, z


def find_photograph(name: str, folder: Path) -> Path | None:
    """Return the photograph of a camera by its name, in one of `_FOLDERS`; None if absent."""
    plain = Path(name).name
    if not plain:
        return None
    candidates = (folder / part / f"{plain}{ending}" for part in _FOLDERS for ending in _ENDINGS)
    return next((path for path in candidates if path.suffix and path.is_file()), None)


def thumbnails(shown: Sequence[Viewpoint]) -> dict[object, Callable[[], Pixels]]:
    """Return functions that load the photographs, by viewpoint."""
    found = [viewpoint for viewpoint in shown if viewpoint.picture is not None][:MAX_THUMBNAILS]
    return {viewpoint.picture: partial(_load, viewpoint.picture) for viewpoint in found if viewpoint.picture}


def _load(path: Path) -> Pixels:
    try:
        with Image.open(path) as photograph:
            photograph.draft("RGB", (THUMBNAIL_PX, THUMBNAIL_PX))
            photograph.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
            return np.asarray(photograph.convert("RGB"))
    except (OSError, ValueError, Image.DecompressionBombError):
        return np.full((2, 2, 3), 90, np.uint8)  # a file that is no picture


def draw(work: Workspace, pointer: PointerContext, textures: dict[object, int]) -> None:
    """Draw the frusta; that under the mouse is bright and has its name.

    Args:
        work: the state
        pointer: the picture
        textures: GL names of the photographs, by file
    """
    shown = work.transient.viewpoints
    if not shown or pointer.shown.compare.mode != "off":
        return
    canvas = imgui.get_background_draw_list()
    scale = pointer.ui.scale
    hit = under(work, pointer)
    for viewpoint in shown:
        places = _places(viewpoint, pointer)
        if places is None:
            continue
        eye, upper_left, upper_right, lower_right, lower_left = places
        corners = upper_left, upper_right, lower_right, lower_left
        texture = textures.get(viewpoint.picture, 0)
        if texture:
            reference = imgui.ImTextureRef(texture)
            canvas.add_image_quad(reference, upper_left, upper_right, lower_right, lower_left)
        is_hit = viewpoint is hit
        ink = u32(PALETTE.handle if is_hit else PALETTE.accent)
        for color, width in ((u32((*PALETTE.scrim[:3], 0.6)), 3.0), (ink, 2.0 if is_hit else 1.0)):
            canvas.add_polyline([*corners], color, width * scale, imgui.ImDrawFlags_.closed.value)
            for corner in corners:
                canvas.add_line(eye, corner, color, width * scale)
    if hit is not None:
        mouse = imgui.get_io().mouse_pos
        at = (mouse.x + 14.0 * scale, mouse.y + 10.0 * scale)
        size = imgui.calc_text_size(hit.name or "camera")
        pad = 4.0 * scale
        end = (at[0] + size.x + 2.0 * pad, at[1] + size.y + 2.0 * pad)
        canvas.add_rect_filled(at, end, u32(PALETTE.scrim), pad)
        canvas.add_text((at[0] + pad, at[1] + pad), u32(PALETTE.text), hit.name or "camera")


def under(work: Workspace, pointer: PointerContext) -> Viewpoint | None:
    """Return the viewpoint whose picture is under the mouse, the nearest one; None for none."""
    io = imgui.get_io()
    if io.want_capture_mouse or pointer.shown.compare.mode != "off":
        return None
    hits = list[tuple[float, Viewpoint]]()
    camera = pointer.camera(pointer.shown.camera)
    row = camera.viewmat[2].double().numpy()
    for viewpoint in work.transient.viewpoints:
        places = _places(viewpoint, pointer)
        if places is not None and _contains(places[1:], (io.mouse_pos.x, io.mouse_pos.y)):
            hits.append((float(row[:3] @ np.array(viewpoint.eye) + row[3]), viewpoint))
    return min(hits, key=lambda hit: hit[0])[1] if hits else None


def look_through(work: Workspace, viewpoint: Viewpoint, pointer: PointerContext) -> Workspace:
    """Glide to a camera, and compare with its photograph if there is one.

    The lens is wide enough for the whole photograph. A photograph that cannot be read is a message.
    """
    before = work.view.camera
    view = _with_whole_picture(viewpoint, pointer.area.width / pointer.area.height)
    photograph = None
    if viewpoint.picture is not None and viewpoint.camera is not None:
        try:
            photograph = load_photograph(viewpoint.picture, viewpoint.camera)
        except ProgdfError as error:
            work = workspace.with_message(work, str(error), pointer.now, error=True)
    work = with_transient(workspace.with_camera(work, view), through=CameraView(view, photograph))
    if photograph is not None:
        mode = "split" if work.view.compare.mode == "off" else work.view.compare.mode
        work = _with_comparison(work, replace(work.view.compare, mode=mode, against=PHOTOGRAPH))
    return work if work.layout.reduced_motion else workspace.glide_from(work, before)


def _with_whole_picture(viewpoint: Viewpoint, aspect: float) -> ViewCamera:
    """Return the view through a camera with a lens that shows its whole picture. `aspect`: of the window"""
    picture = axes(viewpoint.view)
    rays = np.array(viewpoint.corners) - np.array(viewpoint.eye)
    x, y, z = np.array([picture.right, picture.up, picture.back]) @ rays.T
    tangent = max(np.abs(y / z).max(), np.abs(x / z).max() / aspect)
    return replace(viewpoint.view, fov_y=min(math.degrees(2.0 * math.atan(tangent)), 179.0))


def _with_comparison(work: Workspace, compare: Comparison) -> Workspace:
    """Set the comparison without an undo entry, as the view through a camera is none."""
    view = replace(work.view, compare=compare)
    return replace(work, view=view, past=history.follow_look(work.past, work.view, view))


def leave_camera(work: Workspace) -> Workspace:
    """End the view through a camera and the comparison with its photograph if the view has moved on."""
    through = work.transient.through
    if through is not None and work.glide is None:
        is_left = through.view != work.view.camera or not work.transient.viewpoints
        work = with_transient(work, through=None) if is_left else work
    if work.view.compare.against != PHOTOGRAPH or work.transient.through is not None:
        return work
    return _with_comparison(work, replace(work.view.compare, mode="off", against=Comparison.against))


def compared_view(work: Workspace, view: ViewState) -> tuple[ViewState, Photograph | None]:
    """Return the view to draw, and the photograph that it is compared with.

    During the glide to a camera nothing is compared. *Original* covers the picture with the photograph.
    """
    through = work.transient.through
    if view.compare.against != PHOTOGRAPH:
        return view, None
    if through is None or through.photograph is None or through.view != work.view.camera:
        return replace(view, compare=Comparison()), None
    if work.before:
        view = replace(view, compare=replace(view.compare, mode="split", divider=1.0))
    return view, through.photograph


def _places(viewpoint: Viewpoint, pointer: PointerContext) -> list[tuple[float, float]] | None:
    """Return the eye and the corners in the window; None if one is behind the camera, or its view is on."""
    camera = pointer.camera(pointer.shown.camera)
    viewmat = camera.viewmat.double().numpy()
    points = np.array([viewpoint.eye, *viewpoint.corners]) @ viewmat[:3, :3].T + viewmat[:3, 3]
    if (points[:, 2] <= pointer.engine.near).any():
        return None
    pixels = points @ camera.K.double().numpy().T / points[:, 2:]
    density = imgui.get_io().display_framebuffer_scale
    return [((x + pointer.left) / density.x, y / density.y) for x, y, _ in pixels.tolist()]


def _contains(corners: Sequence[tuple[float, float]], at: tuple[float, float]) -> bool:
    """Return whether a convex outline contains a position."""
    sides = []
    for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], corners[0]], strict=True):
        sides.append((x1 - x0) * (at[1] - y0) - (y1 - y0) * (at[0] - x0))
    return min(sides) >= 0.0 or max(sides) <= 0.0
