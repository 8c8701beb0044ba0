"""Cameras with OpenCV axes (x right, y down, z forward), pixel centers at +0.5 and column vectors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from progdf.system.equality import equal_fields

_MAX_LENS_RADIUS = 4.0  # largest checked ray radius, on the plane one unit before the camera (76°)
_LENS_SAMPLES = 4096  # number of radii that are checked for folding back


@dataclass(frozen=True)
class Lens:
    """Radial and tangential distortion as in OpenCV and COLMAP (Brown 1966; Conrady 1919).

    A ray at (x, y) on the plane one unit before the camera, r² = x² + y², meets the sensor at
    x·(1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 xy + p2 (r² + 2x²), and y likewise with p1 and p2 exchanged.

    Raises:
        ValueError: a number is not finite.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(number) for number in astuple(self)):
            raise ValueError(f"the lens has a number that is not finite: {self}")

    def __bool__(self) -> bool:
        """Return whether the lens distorts."""
        return any(astuple(self))

    def distort(self, rays: Tensor) -> Tensor:
        """Return the sensor positions of rays through (x, y, 1), in the same units. [...,2] -> [...,2]"""
        x = rays[..., 0]
        y = rays[..., 1]
        square = x * x + y * y
        radial = 1 + square * (self.k1 + square * (self.k2 + square * self.k3))
        return torch.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (square + 2 * x * x),
                y * radial + self.p1 * (square + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            dim=-1,
        )

    def valid_radius(self) -> float:
        """Return the ray radius beyond which the distortion formula folds back; inf if that is beyond 76°."""
        r = torch.linspace(0.0, _MAX_LENS_RADIUS, _LENS_SAMPLES, dtype=torch.float64)
        slope = 1 + r**2 * (3 * self.k1 + r**2 * (5 * self.k2 + r**2 * 7 * self.k3))
        folded = (slope <= 0).nonzero()
        return math.inf if not len(folded) else float(r[max(0, int(folded[0]) - 1)])


def undistort(photograph: Tensor, K: Tensor, lens: Lens) -> tuple[Tensor, Tensor]:
    """Undistort a photograph to a pinhole camera with the same intrinsics, with bilinear sampling.

    Args:
        photograph: distorted image, 0 to 1. [H,W,3]
        K: intrinsics of both images, in pixels of the photograph; pixel centers at +0.5. [3,3]
        lens: distortion of the photograph

    Returns:
        Undistorted image [H,W,3], and a mask of its pixels that are in the photograph [H,W] bool. Other
        pixels are 0.
    """
    height, width = photograph.shape[:2]
    focal = torch.stack([K[0, 0], K[1, 1]]).double()
    middle = K[:2, 2].double()
    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float64) + 0.5,
        torch.arange(width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    rays = (torch.stack([columns, rows], dim=-1) - middle) / focal
    pixels = lens.distort(rays) * focal + middle
    size = torch.tensor([width, height], dtype=torch.float64)
    visible = ((pixels >= 0) & (pixels <= size)).all(dim=-1) & (rays.norm(dim=-1) < lens.valid_radius())
    grid = (2 * pixels / size - 1).float()
    straight = grid_sample(
        photograph.permute(2, 0, 1)[None], grid[None], padding_mode="border", align_corners=False
    )[0].permute(1, 2, 0)
    return torch.where(visible[..., None], straight, 0.0), visible


MAX_SAMPLING = 16.0
"""Largest `Camera.sampling` for which Gaussians without extent are still drawn."""

NEAR = 0.01
"""Camera z at and below which nothing is drawn, world units, as in `progdf.rasterize`."""


RIGID_TOLERANCE = 4e-4
"""Largest accepted entry of R Rᵀ − I, with R the rotation of a viewmat.

See the margin in `rasterize.cpu.forward.extents`.
"""

_OBLIQUE_TOLERANCE = 1e-6  # largest accepted skew, as a share of the focal length; engines ignore it


@dataclass(frozen=True)
class Camera:
    """Pinhole camera.

    Raises:
        ValueError: a shape is wrong, a size or focal length is not positive, a number is not finite, the
            viewmat is not a rotation and translation, or K has oblique axes.
    """

    __eq__ = equal_fields

    viewmat: Tensor  # world → camera, a rotation and a translation. [4,4] float32, column vectors
    K: Tensor  # intrinsics in pixels, [[fx,0,cx],[0,fy,cy],[0,0,1]]. [3,3] float32
    width: int  # image width in pixels, ≥ 1
    height: int  # image height in pixels, ≥ 1
    name: str = ""  # source of the camera, for messages and file names
    # distortion of this camera's photographs; rasterizers ignore it, because renders are undistorted
    lens: Lens | None = None
    # near plane of a training, world units, see `bounds.near_plane`
    near: float = NEAR
    # supersampling: the pixels are sampled from an image this many times as large, so the 2D blur of
    # Gaussians is narrower by this factor; for trainings only, ignored by OpenGL
    sampling: float = 1.0

    def __post_init__(self) -> None:
        """Check every field, because the engines do not."""
        for name, side in (("viewmat", 4), ("K", 3)):
            shape = list(getattr(self, name).shape)
            if shape != [side, side]:
                raise ValueError(f"{name} has shape {shape}, expected [{side}, {side}]")
            if not bool(getattr(self, name).isfinite().all()):
                raise ValueError(f"{name} has a number that is not finite")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"the image is {self.width}x{self.height} pixels; both must be at least 1")
        if not 1.0 <= self.sampling <= MAX_SAMPLING:
            raise ValueError(f"the sampling is {self.sampling:g}; it must be 1 to {MAX_SAMPLING:g}")
        _check_intrinsics(self.K.tolist())
        fault = rigid_fault(self.viewmat)
        if fault:
            raise ValueError(f"the viewmat {fault}; it must be a rotation and a translation")

    @property
    def c2w(self) -> Tensor:
        """Camera to world matrix. [4,4]"""
        inverse: Tensor = torch.linalg.inv(self.viewmat)
        return inverse

    @property
    def position(self) -> Tensor:
        """Position of the camera, world units. [3]"""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def to(self, device: torch.device) -> Camera:
        """Return the camera with its matrices on another device."""
        return replace(self, viewmat=self.viewmat.to(device), K=self.K.to(device))

    def resize(self, width: int, height: int) -> Camera:
        """Return the camera with another image size; the intrinsics scale with each axis."""
        scale = torch.tensor([[width / self.width], [height / self.height], [1.0]], dtype=self.K.dtype)
        return replace(self, K=self.K * scale, width=width, height=height)


def rigid_fault(matrix: Tensor, tolerance: float = RIGID_TOLERANCE) -> str:
    """Return the deviation of a matrix from a rotation and a translation, such as "scales by 1.7"; or "".

    Args:
        matrix: column vectors, every number finite. [4,4]
        tolerance: largest accepted entry of R Rᵀ − I
    """
    rows = matrix.tolist()  # plain numbers are faster, and the viewer makes a camera for every frame
    if rows[3] != [0.0, 0.0, 0.0, 1.0]:
        last = ", ".join(f"{entry:g}" for entry in rows[3])
        return f"has the last row [{last}]"
    x, y, z = (row[:3] for row in rows[:3])
    square = [_dot(a, b) for a, b in ((x, x), (y, y), (z, z), (x, y), (y, z), (z, x))]
    mean = sum(square[:3]) / 3
    if _largest_error(square, 1.0) > tolerance:
        if mean > 0 and _largest_error(square, mean) <= tolerance * mean:
            return f"scales by {math.sqrt(mean):.4g}"
        return f"stretches or shears (R Rᵀ is off by {_largest_error(square, 1.0):.2g})"
    return "mirrors" if _dot(x, _cross(y, z)) < 0 else ""


def _largest_error(square: Sequence[float], diagonal: float) -> float:
    """Return the largest difference of R Rᵀ (three diagonal entries, three others) from a diagonal matrix."""
    return max(*(abs(entry - diagonal) for entry in square[:3]), *(abs(entry) for entry in square[3:]))


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _check_intrinsics(K: list[list[float]]) -> None:
    """Raise ValueError for focal lengths that are not positive, skew, or another last row than [0, 0, 1]."""
    fx = K[0][0]
    fy = K[1][1]
    if fx <= 0 or fy <= 0:
        raise ValueError(f"focal lengths {fx:g}, {fy:g} px; both must be positive")
    limit = _OBLIQUE_TOLERANCE * max(fx, fy)
    if abs(K[0][1]) > limit or abs(K[1][0]) > limit:
        raise ValueError(f"K has oblique axes ({K[0][1]:g}, {K[1][0]:g}); pixels must be rectangles")
    if K[2] != [0.0, 0.0, 1.0]:
        raise ValueError(f"K has the last row {K[2]}; it must be [0, 0, 1]")


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Return the world to camera matrix of a camera at `eye` that looks at `target`. [4,4] float32

    Args:
        eye: position of the camera, world units. [3]
        target: point in the middle of the image, world units. [3]
        up: world direction that points up in the image. If it is parallel to the viewing direction, the axis
            most perpendicular to that is used. [3]
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
    """Return the intrinsics of a centered camera with square pixels; `fov_y` in radians. [3,3] float32"""
    focal = 0.5 * height / float(torch.tan(torch.tensor(0.5 * fov_y, dtype=torch.float64)))
    return torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
