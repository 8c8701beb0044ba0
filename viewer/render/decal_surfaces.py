"""Surfaces under a decal, computed in another thread: the depth of the view, and the training's surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.surface.find import PaintSurface, find_surface
from progdf.surface.footprint import DepthPicture, depth_picture, near_surface
from viewer.camera.decal_warp import (
    DecalFrame,
    DecalMesh,
    Mask,
    decal_camera,
    is_hidden,
    painted_pixels,
    warp_on_surface,
)

from .background import LatestResult

_DISTANCES = (1.0, 0.5, 0.25)  # tried distances of the projecting camera, shares of the viewer's
_MAX_SIDE_PX = 512  # largest longer side of the decal in its camera's picture, pixels; as in training
_TRIAL_PX = 64  # longer side of the picture that shows what hides a decal


@dataclass(frozen=True)
class LaidDecal:
    """Decal on the surface that training finds."""

    surface: PaintSurface
    mesh: DecalMesh


@dataclass(frozen=True, eq=False)
class _Inputs:
    """Inputs of a computation. The scene and the mask are compared by identity, as they never change."""

    scene: Gaussians
    opaque: Mask | None  # opaque pixels of the decal. [H,W]
    others: tuple[object, ...]  # further inputs, compared by value

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Inputs):
            return NotImplemented
        same = self.scene is other.scene and self.opaque is other.opaque
        return same and self.others == other.others

    def __hash__(self) -> int:
        return hash(self.others)


class DecalSurfaces:
    """Cache of the surfaces under the decal being placed. `drop` it with the scene."""

    def __init__(self) -> None:
        self._depth = LatestResult[DepthPicture]()
        self._laid = LatestResult[LaidDecal]()

    def depth(self, scene: Gaussians, camera: Camera, at_once: bool = False) -> DepthPicture | None:
        """Return the depth picture of a camera; None while it is computed.

        Args:
            scene: the original; it must not change
            camera: camera of the picture
            at_once: wait for it
        """
        lens = camera.viewmat.numpy().tobytes(), camera.K.numpy().tobytes()
        key = _Inputs(scene, None, (*lens, camera.width, camera.height))
        if not self._depth.has(key):
            self._laid.drop()  # the pointer must not wait for it

        def make() -> DepthPicture:
            return depth_picture(scene, camera)

        return self._depth.finish(key, make) if at_once else self._depth.get(key, make)

    def laid(
        self, scene: Gaussians, frame: DecalFrame, shape: tuple[int, int], opaque: Mask, near_plane: float
    ) -> LaidDecal | None:
        """Return a decal on the surface that training finds; None while it is computed.

        Args:
            scene: the original; it must not change
            frame: frame of the decal
            shape: width and height of its picture
            opaque: pixels of its picture that are not transparent. [h,w]
            near_plane: near plane of the view, world units
        """

        def make() -> LaidDecal:
            small = replace(frame, pixel=max(frame.pixel, frame.size / _MAX_SIDE_PX))
            camera = replace(decal_camera(small, shape)[0], near=near_plane)
            center = (camera.width / 2, camera.height / 2)
            near = near_surface(depth_picture(scene, camera), *center, small.size_px)
            surface = find_surface(scene, camera, near & painted_pixels(small, camera, opaque))
            return LaidDecal(surface, warp_on_surface(frame, shape, surface, near))

        return self._laid.get(_Inputs(scene, opaque, (frame, shape, near_plane)), make)

    @property
    def is_busy(self) -> bool:
        """True if a result is being computed."""
        return self._depth.is_busy or self._laid.is_busy

    def drop(self) -> None:
        """Cancel all computations."""
        self._depth.drop()
        self._laid.drop()


def unhidden_frame(
    scene: Gaussians, frame: DecalFrame, shape: tuple[int, int], mesh: DecalMesh, near: float
) -> DecalFrame:
    """Return the frame with the farthest camera from which nothing hides the decal.

    If something hides it from all of them, the frame is unchanged.
    """
    for share in _DISTANCES:
        tried = replace(frame, distance=share * frame.distance)
        camera = decal_camera(tried, shape)[0]
        shrink = _TRIAL_PX / max(camera.width, camera.height)
        small = camera.resize(round(camera.width * shrink), round(camera.height * shrink))
        if not is_hidden(mesh, tried, depth_picture(scene, replace(small, near=near))):
            return tried
    return frame
