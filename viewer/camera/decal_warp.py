"""Decal on a surface: its frame, the camera that projects it in training, and its warped preview (ghost).

A decal is projected along the normal of the surface under its center, as training does with the same camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.surface.find import MIN_COSINE, PaintSurface
from progdf.surface.footprint import DepthPicture, Footprint

from .view_camera import Vec3

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELLS = 24
"""Cells of the ghost along each side."""

_DEPTH_STEPS = 16  # depths between which a ray crosses the surface
_MARGIN_SHARE = 0.25  # margin around the decal in its camera's picture, share of its box
_MARGIN_PX = 24  # added to that margin, pixels; training compares a ring of 15 px around the paint
_LEVEL_SINE = 0.5  # sine of the slope below which a surface counts as horizontal and has no level


@dataclass(frozen=True)
class DecalFrame:
    """Position, direction and size of a decal on a surface."""

    center: Vec3  # surface point under its center, world units
    normal: Vec3  # unit normal of the surface, towards the viewer
    upright: Vec3  # unit vector along the surface: the decal's upper side at an angle of 0
    size: float  # longer side, world units
    angle: float  # degrees counterclockwise from `upright`
    distance: float  # from the projecting camera to the center, world units
    pixel: float  # a pixel of the projecting camera at the center, world units

    @property
    def size_px(self) -> float:
        """Longer side in pixels of the projecting camera."""
        return self.size / self.pixel

    def axes(self) -> tuple[Floats, Floats]:
        """Return the unit vectors to the right and up of the rotated decal. [3] each"""
        up = np.array(self.upright)
        right = np.cross(up, np.array(self.normal))
        cosine = math.cos(math.radians(self.angle))
        sine = math.sin(math.radians(self.angle))
        return cosine * right + sine * up, cosine * up - sine * right


@dataclass(frozen=True, eq=False)
class DecalMesh:
    """Points of a decal on the surface, on a regular grid over its picture."""

    points: Floats  # world units, from the upper left corner. [R,C,3]
    shown: Mask  # points on the surface. [R,C]
    joined: Mask  # cells that cross no step between two surfaces. [R-1,C-1]


def upright_on(normal: Vec3, up: Vec3, view_up: Vec3, level: bool) -> Vec3:
    """Return the upright direction on a surface: the up axis along it, or the picture's.

    Args:
        normal: unit normal of the surface
        up: up axis of the world, unit length
        view_up: up axis of the picture, unit length
        level: use the world's axis, except on horizontal surfaces
    """
    n = np.array(normal)
    for axis, least in ((up if level else view_up, _LEVEL_SINE if level else 0.0), (view_up, 0.0)):
        along = np.array(axis) - np.dot(axis, n) * n
        length = float(np.linalg.norm(along))
        if length > max(least, 1e-6):
            return vec3(along / length)
    along = np.cross(n, np.eye(3)[int(np.abs(n).argmin())])
    return vec3(along / np.linalg.norm(along))


def vec3(values: Floats) -> Vec3:
    """Return an array of three numbers as a tuple."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def decal_camera(frame: DecalFrame, shape: tuple[int, int]) -> tuple[Camera, str]:
    """Return the camera that projects a decal, and the value of `progdf train --at`.

    Args:
        frame: frame of the decal
        shape: width and height of its picture
    """
    up = np.array(frame.upright)
    normal = np.array(frame.normal)
    rows = np.stack([np.cross(up, normal), -up, -normal])  # OpenCV axes
    viewmat = np.eye(4)
    viewmat[:3, :3] = rows
    viewmat[:3, 3] = -rows @ (np.array(frame.center) + frame.distance * normal)
    size_px = frame.size_px
    width_px, height_px = (size_px * side / max(shape) for side in shape)
    cosine = abs(math.cos(math.radians(frame.angle)))
    sine = abs(math.sin(math.radians(frame.angle)))
    box = (width_px * cosine + height_px * sine, width_px * sine + height_px * cosine)
    width, height = (math.ceil(side * (1 + 2 * _MARGIN_SHARE)) + 2 * _MARGIN_PX for side in box)
    K = torch.eye(3)
    K[0, 0] = K[1, 1] = frame.distance / frame.pixel
    K[0, 2] = width / 2
    K[1, 2] = height / 2
    camera = Camera(torch.from_numpy(viewmat).float(), K, width, height)
    numbers = (width / 2, height / 2, size_px, frame.angle)
    return camera, ",".join(f"{number:.2f}" for number in numbers)


def plane_points(frame: DecalFrame, shape: tuple[int, int], cells: int = CELLS) -> Floats:
    """Return the points of a flat decal on the tangent plane, from the upper left corner. [R,C,3]"""
    right, up = frame.axes()
    width, height = (frame.size * side / max(shape) for side in shape)
    steps = np.linspace(-0.5, 0.5, cells + 1)
    across = steps[None, :, None] * width * right
    down = -steps[:, None, None] * height * up
    points: Floats = np.array(frame.center) + across + down
    return points


def project(points: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Return the pixel positions and depths of world points. [...,3] -> [...,2], [...]"""
    viewmat = camera.viewmat.double().numpy()
    inside = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    depths = inside[..., 2]
    K = camera.K.double().numpy()
    safe = np.where(np.abs(depths) > 1e-9, depths, 1e-9)
    pixels = inside[..., :2] / safe[..., None] * K[[0, 1], [0, 1]] + K[:2, 2]
    return pixels, depths


def warp_on_footprint(
    frame: DecalFrame, shape: tuple[int, int], footprint: Footprint, picture: DepthPicture
) -> DecalMesh:
    """Project a decal onto the surface of a footprint.

    A ray meets the surface where it first crosses it, at most the decal's size before or behind the tangent
    plane. Points of the surface that the picture does not show there, such as holes, are left out.
    """
    flat = plane_points(frame, shape)
    eye = np.array(frame.center) + frame.distance * np.array(frame.normal)
    reach = min(frame.size / frame.distance, 0.9)
    steps = np.linspace(1.0 - reach, 1.0 + reach, _DEPTH_STEPS)
    rays = eye + steps[:, None, None, None] * (flat - eye)
    viewmat = picture.camera.viewmat.double().numpy()
    inside = rays @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = np.maximum(inside[..., 2], 1e-9)
    behind = z * footprint.model.inverse_depth(inside[..., 0] / z, inside[..., 1] / z) - 1.0
    crosses = (behind[:-1] < 0) & (behind[1:] >= 0)
    first = crosses.argmax(axis=0)[None]
    before = np.take_along_axis(behind, first, 0)[0]
    after = np.take_along_axis(behind, first + 1, 0)[0]
    found = crosses.any(axis=0)
    share = np.where(found, before / np.where(found, before - after, 1.0), 0.0)
    step = np.where(found, steps[first[0]] + share * (steps[1] - steps[0]), 1.0)
    points = eye + step[..., None] * (flat - eye)
    shown = found & _is_surface(points, picture, footprint.limit_px)
    return DecalMesh(points, shown, _cells_of_one_surface(points, flat))


def _is_surface(points: Floats, picture: DepthPicture, limit_px: float) -> Mask:
    """Return True for points at the depth of a picture, and for points outside the picture. [R,C]"""
    pixels, depths = project(points, picture.camera)
    height, width = picture.depth.shape
    columns = np.floor(pixels[..., 0]).astype(np.int64)
    rows = np.floor(pixels[..., 1]).astype(np.int64)
    outside = (columns < 0) | (columns >= width) | (rows < 0) | (rows >= height)
    at = rows.clip(0, height - 1), columns.clip(0, width - 1)
    apart = np.abs(depths - picture.depth[at]) / np.maximum(depths, 1e-9)
    near = apart * float(picture.camera.K[0, 0]) <= limit_px
    return np.asarray(outside | (picture.opaque[at] & near))


def warp_on_surface(
    frame: DecalFrame, shape: tuple[int, int], surface: PaintSurface, near: Mask
) -> DecalMesh:
    """Project a decal onto the surface that training finds from the decal's camera.

    Args:
        frame: frame of the decal
        shape: width and height of its picture
        surface: the surface
        near: pixels of the camera that the decal may cover, see `near_surface`. [H,W]
    """
    flat = plane_points(frame, shape)
    pixels, _ = project(flat, surface.camera)
    height, width = surface.depth.shape
    columns = np.floor(pixels[..., 0]).astype(np.int64).clip(0, width - 1)
    rows = np.floor(pixels[..., 1]).astype(np.int64).clip(0, height - 1)
    eye = np.array(frame.center) + frame.distance * np.array(frame.normal)
    share = surface.depth[rows, columns] / frame.distance
    points = eye + share[..., None] * (flat - eye)
    return DecalMesh(points, near[rows, columns], _cells_of_one_surface(points, flat))


def _cells_of_one_surface(points: Floats, flat: Floats) -> Mask:
    """Return the cells no steeper than the steepest disc. [R,C,3] each -> [R-1,C-1]"""
    stretch = [
        np.linalg.norm(np.diff(points, axis=axis), axis=2) / np.linalg.norm(np.diff(flat, axis=axis), axis=2)
        for axis in (0, 1)
    ]
    down, across = (sides <= 1.0 / MIN_COSINE for sides in stretch)
    return np.asarray(down[:, 1:] & down[:, :-1] & across[1:] & across[:-1])


def visible_cells(mesh: DecalMesh, camera: Camera) -> tuple[Floats, Mask]:
    """Return the pixel positions of a mesh, and the cells that face the camera. [R,C,2], [R-1,C-1]"""
    pixels, depths = project(mesh.points, camera)
    fine = mesh.shown & (depths > 0)
    whole = fine[:-1, :-1] & fine[1:, :-1] & fine[:-1, 1:] & fine[1:, 1:]
    across = pixels[:-1, 1:] - pixels[:-1, :-1]
    down = pixels[1:, :-1] - pixels[:-1, :-1]
    faces = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] > 0
    return pixels, whole & faces & mesh.joined


def painted_pixels(frame: DecalFrame, camera: Camera, opaque: Mask) -> Mask:
    """Return the pixels of the projecting camera that the decal paints. [H,W]

    Args:
        frame: frame of the decal
        camera: its camera, see `decal_camera`
        opaque: pixels of the decal's picture that are not transparent. [h,w]
    """
    height, width = opaque.shape
    scale = max(width, height) / frame.size_px
    x = (np.arange(camera.width) + 0.5 - camera.width / 2) * scale
    y = (np.arange(camera.height)[:, None] + 0.5 - camera.height / 2) * scale
    cosine = math.cos(math.radians(frame.angle))
    sine = math.sin(math.radians(frame.angle))
    columns = np.floor(cosine * x - sine * y + width / 2).astype(np.int64)
    rows = np.floor(sine * x + cosine * y + height / 2).astype(np.int64)
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    return np.asarray(inside & opaque[rows.clip(0, height - 1), columns.clip(0, width - 1)])


def is_hidden(mesh: DecalMesh, frame: DecalFrame, seen: DepthPicture) -> bool:
    """Return True if most of a decal lies behind something, as its camera sees it.

    Args:
        mesh: the decal on the surface
        frame: frame of the decal
        seen: depth picture of the projecting camera, of any size
    """
    pixels, depths = project(mesh.points[mesh.shown], seen.camera)
    height, width = seen.depth.shape
    columns = np.floor(pixels[:, 0]).astype(np.int64).clip(0, width - 1)
    rows = np.floor(pixels[:, 1]).astype(np.int64).clip(0, height - 1)
    before = seen.opaque[rows, columns] & (seen.depth[rows, columns] < depths - frame.size)
    return bool(len(before)) and bool(before.mean() > 0.5)
