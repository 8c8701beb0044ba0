"""`progdf.rasterize.simplification.simplify` in plain torch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import normalize_quats
from progdf.rasterize.engines import (
    ALPHA_MAX,
    ALPHA_MIN,
    ANTIALIAS_FLOOR,
    DILATION,
    FRUSTUM_MARGIN,
    ActivatedGaussians,
    RasterView,
)  # fmt: skip
from progdf.rasterize.reference import covariances
from progdf.rasterize.simplification import CELL, DENSE, GOLDEN, LEAST_LIGHT, MOST_TIMES, SLICES
from progdf.sh import shade


def plain_simplify(
    gaussians: ActivatedGaussians, camera: Camera, budget: int, pixels: int = 1
) -> tuple[ActivatedGaussians, Tensor]:
    """See `progdf.rasterize.simplification.simplify`; and which of the Gaussians these are. [M] int64

    Every number is that of the fast one but for rounding; the threshold is sought by halving.
    """
    dilation = DILATION / pixels**2
    view = RasterView.of(camera, gaussians)
    means, quats, scales, opacities, colors = (tensor.double() for tensor in gaussians.tensors)
    rotation, translation = camera.viewmat[:3, :3].double(), camera.viewmat[:3, 3].double()
    points = means @ rotation.T + translation
    x, y, z = points.unbind(1)
    fx, fy, cx, cy = (float(camera.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    px, py = fx * x / z + cx, fy * y / z + cy
    longest = scales.abs().max(1).values / z
    drawn = (z > camera.near) & (opacities >= ALPHA_MIN)
    for place, extent, focal, center, side in (
        (px, x / z, fx, cx, camera.width), (py, y / z, fy, cy, camera.height),
    ):  # fmt: skip
        margin = FRUSTUM_MARGIN * 0.5 * side / focal
        tangent = extent.clamp(-(center / focal + margin), (side - center) / focal + margin)
        reach2 = 1.001 * -2.0 * math.log(ALPHA_MIN) * ((focal * longest) ** 2 * (1 + tangent**2) + DILATION)
        drawn &= torch.maximum(-place, place - side).clamp_min(0.0) ** 2 <= reach2
    rows = drawn.nonzero()[:, 0]
    px, py, z, opacities = px[rows], py[rows], z[rows], opacities[rows]
    squares = scales[rows].square().sort(1).values[:, 1:] * (fx * fy / z**2)[:, None]
    weights = opacities * (squares + (0.0 if gaussians.antialiased else dilation)).prod(1).sqrt()
    shape = (-(-camera.height // CELL), -(-camera.width // CELL), SLICES)
    bits = (z / camera.near).float().view(torch.int32) - torch.tensor(1.0).view(torch.int32)
    cells = (
        py.clamp(0, camera.height - 1).long() // CELL,
        px.clamp(0, camera.width - 1).long() // CELL,
        (bits >> 19).long().clamp(0, SLICES - 1),
    )
    density = torch.zeros(shape, dtype=torch.double)
    density.index_put_(cells, weights * (2.0 * math.pi / CELL**2), accumulate=True)
    threshold = 0.0
    if len(rows) > budget:
        before = density.cumsum(2) - density
        before = -torch.nn.functional.max_pool2d(-before.permute(2, 0, 1), 3, 1, 1).permute(1, 2, 0)
        weights = weights * (-before[cells]).exp().clamp_min(LEAST_LIGHT)
        low, high = 0.0, float(weights.sum()) / budget
        for _ in range(100):
            threshold = 0.5 * (low + high)
            fewer = float((weights / threshold).clamp_max(1.0).sum()) < budget
            low, high = (low, threshold) if fewer else (threshold, high)
    kept = weights >= threshold * (rows.double() * GOLDEN % 1.0)
    rows, weights, z, dense, opacities = (
        values[kept] for values in (rows, weights, z, density[cells], opacities)
    )
    stands_for = threshold / weights
    denser = torch.minimum(stands_for, ALPHA_MAX / opacities).clamp_min(1.0)
    enough = (DENSE / dense.clamp_min(1e-6)).clamp_max(1.0)
    larger = (enough * stands_for / denser).clamp(1.0, MOST_TIMES)
    a, _, c, det0 = covariances(points[rows], normalize_quats(quats[rows]), scales[rows], view)
    fine = det0 + dilation * (a + c) + dilation**2
    more = (larger * dilation - DILATION) * z**2 / (fx * fy)
    sizes = (larger[:, None] * scales[rows] ** 2 + more[:, None]).clamp_min(0.0).sqrt()
    a, _, c, det = covariances(points[rows], normalize_quats(quats[rows]), sizes, view)
    coarse = det + DILATION * (a + c) + DILATION**2
    opacity = opacities * denser * larger * (fine / coarse).sqrt()
    if gaussians.antialiased:
        opacity = opacity * (det0 / fine).clamp_min(ANTIALIAS_FLOOR).sqrt()
    rgb = colors[rows]
    if view.sh_degree is not None:
        direction = torch.nn.functional.normalize(means[rows] + rotation.T @ translation, dim=1, eps=1e-300)
        rgb = shade(view.sh_degree, direction, rgb)
    found = ActivatedGaussians(means[rows], quats[rows], sizes, opacity, rgb)
    return found.each(Tensor.float), rows
