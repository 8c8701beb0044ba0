"""Cameras: OpenCV axes (x right, y down, z forward), pixel centers at +0.5, column vectors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .lens import Lens

NEAR = 0.01
"""Camera z at and below which nothing is drawn, world units; as `progdf.rasterize`."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Args:
        viewmat: world → camera. [4,4] float32, column vectors
        K: intrinsics in pixels, [[fx,0,cx],[0,fy,cy],[0,0,1]]. [3,3] float32
        width: image width in pixels, ≥ 1
        height: image height in pixels, ≥ 1
        name: where it came from, for messages and file names
        lens: what bends photographs that this camera took; a render is straight, so nothing that draws asks
        near: depth at and below which a training draws nothing, world units, see `bounds.near_plane`

    Raises:
        ValueError: a shape is wrong, a size or focal length is not positive, a number is not finite.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    name: str = ""
    lens: Lens | None = None
    near: float = NEAR

    def __post_init__(self) -> None:
        for name, side in (("viewmat", 4), ("K", 3)):
            found = list(getattr(self, name).shape)
            if found != [side, side]:
                raise ValueError(f"{name} has shape {found}, expected [{side}, {side}]")
            if not bool(getattr(self, name).isfinite().all()):
                raise ValueError(f"{name} has a number that is not finite")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"the image is {self.width}x{self.height} pixels; both must be at least 1")
        fx, fy = self.K.detach().diagonal()[:2].tolist()
        if fx <= 0 or fy <= 0:
            raise ValueError(f"focal lengths {fx:g}, {fy:g} px; both must be positive")

    @property
    def c2w(self) -> Tensor:
        """Camera → world. [4,4]"""
        inverse: Tensor = torch.linalg.inv(self.viewmat)
        return inverse

    @property
    def position(self) -> Tensor:
        """The camera's center in world units. [3]"""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def resize(self, width: int, height: int) -> Camera:
        """The same view in another image size; the intrinsics scale with each axis."""
        scale = torch.tensor([[width / self.width], [height / self.height], [1.0]], dtype=self.K.dtype)
        return replace(self, K=self.K * scale, width=width, height=height)


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """World → camera matrix of a camera at `eye` that looks at `target`. [3], [3], [3] -> [4,4] float32.

    `up` is the world direction that shall point up in the image; if it is parallel to the view direction,
    the nearest other axis is taken.
    """
    eye, target, up = (v.to(torch.float64) for v in (eye, target, up))
    forward = target - eye
    forward = (
        forward / forward.norm() if float(forward.norm()) > 0 else torch.tensor([0.0, 0.0, 1.0]).double()
    )
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) < 1e-6 * float(up.norm()):
        axis = torch.zeros(3, dtype=torch.float64)
        axis[int(forward.abs().argmin())] = 1.0
        right = torch.linalg.cross(forward, axis)
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([right, down, forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat.float()


def intrinsics(fov_y: float, width: int, height: int) -> Tensor:
    """Intrinsics of a centered camera with square pixels; `fov_y` in radians. [3,3] float32"""
    focal = 0.5 * height / float(torch.tan(torch.tensor(0.5 * fov_y, dtype=torch.float64)))
    return torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
