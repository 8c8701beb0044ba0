"""Image registration: the shift and zoom of a painted picture against its original."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

_MAX_MISFIT_RATIO = 0.8  # maximum ratio of the misfits after and before; noise alone gains a little
_MIN_TEXTURE = 0.01  # standard deviation of color; smoother areas match at any position
_TUKEY = 4.685  # in standard deviations; 95 % of the efficiency of least squares under normal noise


@dataclass(frozen=True)
class Registration:
    """Alignment of painted pixels: a point at `p` from the view's center is found at (1 + zoom) p + shift."""

    shift: tuple[float, float] = (0.0, 0.0)  # x, y, shares of the longer side
    zoom: float = 0.0

    @property
    def size(self) -> float:
        """The largest magnitude of the three parameters."""
        return max(abs(self.shift[0]), abs(self.shift[1]), abs(self.zoom))

    def lay(self, picture: Tensor) -> Tensor:
        """Return the painted picture, moved back; the same bits if it moved less than 0.25 pixels. [H,W,3]"""
        longer = max(picture.shape[:2])
        if self.size * longer < 0.25:
            return picture
        planes = picture.permute(2, 0, 1)[None]
        parameters = torch.tensor([*self.shift, self.zoom], dtype=torch.float64)
        return _sample(planes, parameters, "bicubic")[0].permute(1, 2, 0).clamp(0.0, 1.0)


def register(original: Tensor, picture: Tensor, beside: Tensor) -> Registration:
    """Return the shift and zoom of a picture against the original, by robust coarse-to-fine Gauss-Newton.

    Global brightness and contrast may differ. The result is the identity if the surroundings of the region
    have no texture or were repainted.

    Args:
        original, picture: [H,W,3]
        beside: pixels that should be the same in both. [H,W] bool
    """
    levels = []
    planes = [image.permute(2, 0, 1)[None] for image in (original, picture)]
    masks = beside.float()[None, None]
    for level in range(6):
        factor = 2**level
        height, width = (side // factor for side in beside.shape)
        if level and min(height, width) < 12:
            break
        a, b, weight = (interpolate(image, (height, width), mode="area") for image in (*planes, masks))
        levels.append((a, b, (weight > 0.999).float()))
    parameters = torch.zeros(3, dtype=torch.float64)
    for a, b, weight in reversed(levels):
        for _ in range(12):
            step, _ = _step(a, b, weight, parameters)
            parameters = parameters + step
            if float(step.abs().max()) * max(a.shape[2:]) < 0.01:
                break
    a, b, weight = levels[0]
    before, after = (_step(a, b, weight, values)[1] for values in (torch.zeros_like(parameters), parameters))
    if not after < _MAX_MISFIT_RATIO * before:
        return Registration()
    x, y, zoom = parameters.tolist()
    return Registration((x, y), zoom)


def _step(a: Tensor, b: Tensor, weight: Tensor, parameters: Tensor) -> tuple[Tensor, float]:
    """Return one Gauss-Newton step with Tukey weights [3], and the robust misfit before it."""
    moved = _sample(b, parameters)
    x, y = _pixel_positions(b)
    counts = (weight > 0)[0, 0]
    if int(counts.sum()) < 16 or float(a[0][:, counts].std(dim=1).max()) < _MIN_TEXTURE:
        return torch.zeros(3, dtype=torch.float64), 0.0
    gradients = [
        torch.nn.functional.pad((moved[..., 2:] - moved[..., :-2]) / 2, (1, 1)),
        torch.nn.functional.pad((moved[..., 2:, :] - moved[..., :-2, :]) / 2, (0, 0, 1, 1)),
    ]
    gx, gy = (g[0][:, counts].double() * max(a.shape[2:]) for g in gradients)
    target = a[0][:, counts].double()
    source = moved[0][:, counts].double()
    gain = target.std(dim=1, keepdim=True) / source.std(dim=1, keepdim=True).clamp_min(1e-6)
    gain = gain.clamp(0.5, 2.0)
    residual = target - (source - source.mean(1, keepdim=True)) * gain - target.mean(1, keepdim=True)
    spread = 1.4826 * float(residual.abs().median()) + 1e-3
    rho = (1 - (residual / (_TUKEY * spread)).square()).clamp_min(0.0).square()
    jacobian = gain[..., None] * torch.stack([gx, gy, x[counts] * gx + y[counts] * gy], dim=2)
    jacobian = jacobian.reshape(-1, 3)
    normal = jacobian.T @ (rho.reshape(-1, 1) * jacobian)
    slope = jacobian.T @ (rho * residual).reshape(-1)
    damping = 1e-4 * normal.diagonal().max() + 1e-9
    step = torch.linalg.solve(normal + damping * torch.eye(3, dtype=torch.float64), slope)
    return step.clamp(-0.05, 0.05), float(residual.abs().clamp_max(0.1).mean())


def _pixel_positions(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and y of the pixels from the center, in shares of the longer side. [H,W] float64 each"""
    height, width = planes.shape[2:]
    longer = max(height, width)
    y = (torch.arange(height, dtype=torch.float64) + 0.5 - height / 2) / longer
    x = (torch.arange(width, dtype=torch.float64) + 0.5 - width / 2) / longer
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    return columns, rows


def _sample(planes: Tensor, parameters: Tensor, mode: str = "bilinear") -> Tensor:
    """Return the planes sampled at the positions of `Registration`. [1,C,H,W]"""
    x, y = _pixel_positions(planes)
    height, width = planes.shape[2:]
    dx, dy, zoom = parameters.tolist()
    scale = 2 * max(height, width)
    grid = torch.stack([scale / width * ((1 + zoom) * x + dx), scale / height * ((1 + zoom) * y + dy)], dim=2)
    return grid_sample(planes, grid.float()[None], mode, padding_mode="border", align_corners=False)
