"""Points of the surface under the pointer, for the Pull tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from imgui_bundle import imgui

from progdf.camera import Camera
from progdf.gdf.file import Gdf
from progdf.quaternions import normalize_quats, rotation_matrices
from viewer.camera.decal_warp import Floats, vec3
from viewer.camera.view_camera import Vec3
from viewer.render.picking import SURFACE_OPACITY, seen_at
from viewer.ui.pointer import PointerContext


@dataclass(frozen=True)
class SurfacePoint:
    """Point of the visible surface."""

    point: Vec3  # world units
    offset: Vec3  # its displacement by the pull, world units
    row: int  # Gaussian of the scene that it lies on

    @property
    def rest(self) -> Vec3:
        """Position without the pull, world units."""
        (x, y, z), (dx, dy, dz) = self.point, self.offset
        return x - dx, y - dy, z - dz


def is_over(pointer: PointerContext) -> bool:
    """Return True if the mouse is over the picture and no part of the interface takes it."""
    io = imgui.get_io()
    area = pointer.area
    inside = 0.0 <= io.mouse_pos.x < area.width and 0.0 <= io.mouse_pos.y < area.height
    return inside and not io.want_capture_mouse


def moves_camera() -> bool:
    """Return True if the middle or the right button is down."""
    return any(imgui.is_mouse_down(button) for button in (1, 2))


def camera_of(pointer: PointerContext) -> Camera:
    """Return the camera of the picture."""
    return pointer.camera(pointer.shown.camera)


def pick(edit: Gdf | None, pointer: PointerContext) -> SurfacePoint | None:
    """Return the point of the surface under the pointer; None on the background.

    Its Gaussian is one of the scene's own, as paint has no place of its own.

    Args:
        edit: the pull on screen
        pointer: the view
    """
    scene = pointer.scene
    camera = camera_of(pointer)
    seen = seen_at(scene, camera, *pointer.cursor, pointer.engine.near)
    if seen is None:
        return None
    own = seen.rows < pointer.facts.count - pointer.facts.added
    if not own.any():
        return None
    reached = np.flatnonzero(own & (np.cumsum(seen.shares) >= SURFACE_OPACITY))
    at = int(reached[0]) if len(reached) else int(np.argmax(np.where(own, seen.shares, -1.0)))
    row = int(seen.rows[at])
    point = unproject(camera, pointer.cursor, float(seen.depths[at]))
    center = scene.means[row].double().numpy()
    reach = 2.0 * float(scene.log_scales[row].double().exp().max())
    away = float(np.linalg.norm(point - center))
    if away > reach:  # the pixel only touches the edge of the Gaussian
        point = center + (point - center) * (reach / away)
    if not np.isfinite(point).all():
        return None
    return SurfacePoint(vec3(point), vec3(_offset(edit, row)), row)


def _offset(edit: Gdf | None, row: int) -> Floats:
    """Return the displacement of a Gaussian by the pull on screen. [3]"""
    if edit is None:
        return np.zeros(3)
    members = edit.region.members.numpy()
    at = int(np.searchsorted(members, row))
    if at == len(members) or members[at] != row:
        return np.zeros(3)
    offset: Floats = edit.field.attributes["means"].end_offset[at].double().numpy()
    return offset


def unproject(camera: Camera, pixel: tuple[float, float], depth: float) -> Floats:
    """Return the point at a pixel and a depth, world units. [3]"""
    K = camera.K.double().numpy()
    viewmat = camera.viewmat.double().numpy()
    x = (pixel[0] - K[0, 2]) / K[0, 0] * depth
    y = (pixel[1] - K[1, 2]) / K[1, 1] * depth
    point: Floats = viewmat[:3, :3].T @ (np.array([x, y, depth]) - viewmat[:3, 3])
    return point


def normal_at(pointer: PointerContext, row: int) -> Vec3:
    """Return the direction of a Gaussian's shortest axis, towards the camera."""
    scene = pointer.scene
    rotation = rotation_matrices(normalize_quats(scene.quats[row : row + 1].double()))[0].numpy()
    normal = rotation[:, int(scene.log_scales[row].argmin())]
    eye = camera_of(pointer).position.double().numpy()
    towards = float(normal @ (eye - scene.means[row].double().numpy()))
    return vec3(normal if towards >= 0.0 else -normal)
