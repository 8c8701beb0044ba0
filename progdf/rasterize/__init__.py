"""The differentiable rasterizer: one signature, several engines.

`reference` is plain torch, slow, in any floating type: the oracle. `cpu` is numba, fast, with an analytic
backward. The conventions both follow are in `conventions.py`; beyond those numbers:

- the support of a Gaussian is exactly {alpha ≥ 1/255}, whatever the tile size;
- the near plane cuts at camera z > `near`; order is camera z in float32, ties by index;
- pixel centers lie at column + 0.5, row + 0.5;
- a Gaussian with a number that is not finite is not drawn; a quaternion that is zero or not finite is the
identity.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians

from .conventions import RasterInfo
from .cpu.parallel import set_threads
from .engines import ENGINES, ActivatedGaussians, Crop, RasterView, get_engine

__all__ = ["ENGINES", "Crop", "RasterInfo", "alpha_weights", "rasterize", "render", "set_threads"]


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor | Sequence[float] | None = None,
    near: float = 0.01,
    sh_degree: int | None = None,
    antialiased: bool = False,
    engine: str = "cpu",
    crop: Crop | None = None,
    grad_rows: Tensor | None = None,
) -> tuple[Tensor, Tensor, RasterInfo]:
    """Draw Gaussians in activated units (Kerbl et al. 2023), differentiable in every floating input.

    Args:
        means: centers, world units. [N,3]
        quats: rotations wxyz, any nonzero length. [N,4]
        scales: standard deviations, world units, ≥ 0. [N,3]
        opacities: 0..1. [N]
        colors: rgb [N,3], or with `sh_degree` spherical-harmonic coefficients [N,≥(d+1)²,3]
        viewmat: world → camera, OpenCV axes, orthonormal rotation. [4,4]
        K: intrinsics in pixels; no skew. [3,3]
        width, height: size of the full image in pixels
        background: rgb behind everything, None is black. [3]
        near: camera z below and at which nothing is drawn, world units
        sh_degree: 0..3; None where `colors` is rgb
        antialiased: scale opacities by sqrt(det/dilated det) of the 2D covariance (Mip-Splatting)
        engine: a key of `ENGINES`; "cpu" computes in float32 (projection in float64) whatever the inputs'
            type
        crop: draw only this window, with the full image's conventions; equals the slice of the full image
            bit for bit. Gaussians that do not touch it cost next to nothing

        grad_rows: only these rows get gradients, all others zero; takes much less time where they are few.
            [M] int64

    Returns:
        image [H,W,3], transmittance [H,W] (of the window where there is a crop), and what the projection
        found.

    Raises:
        ValueError: a shape does not fit, the crop is empty or leaves the image, the engine is unknown,
            `grad_rows` are given although the camera wants gradients, which need all rows.
        ProgdfError: more (Gaussian, tile) pairs than memory should hold.
    """
    _check_shapes(means, quats, scales, opacities, colors, viewmat, K, sh_degree)
    window = _resolve_crop(crop, width, height)
    if grad_rows is not None and (viewmat.requires_grad or K.requires_grad):
        raise ValueError("grad_rows are given, but viewmat or K wants gradients, which need all rows")
    if background is None:
        background = means.new_zeros(3)
    elif not isinstance(background, Tensor):
        background = torch.tensor(background, dtype=means.dtype)
    if tuple(background.shape) != (3,):
        raise ValueError(f"background has shape {list(background.shape)}, expected [3]")
    gaussians = ActivatedGaussians(means, quats, scales, opacities, colors)
    view = RasterView(viewmat, K, width, height, window, near, sh_degree, antialiased)
    return get_engine(engine).rasterize(gaussians, view, background, grad_rows)


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Tensor | Sequence[float] = (1.0, 1.0, 1.0),
    engine: str = "cpu",
    crop: Crop | None = None,
) -> Tensor:
    """Draw a scene of raw Gaussians; bands of spherical harmonics above 3 are not shown.

    A scene that was trained anti-aliased is drawn so (`Gaussians.antialiased`).

    Returns:
        image [H,W,3] float32 in 0..1 as far as the colors are (of the window where there is a `crop`)
    """
    degree = min(gaussians.sh_degree, 3)
    image, _, _ = rasterize(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh,
        camera.viewmat, camera.K, camera.width, camera.height, background, camera.near,
        sh_degree=degree, antialiased=gaussians.antialiased, engine=engine, crop=crop,
    )  # fmt: skip
    return image.float()


def alpha_weights(
    gaussians: Gaussians, camera: Camera, mask: Tensor, engine: str = "cpu", near: float = 0.01
) -> Tensor:
    """What each Gaussian contributes to a view, inside a mask and in all (docs/method.md 4).

    Args:
        gaussians: raw parameters
        camera: the view
        mask: 0..1 or bool, of the camera's size. [H,W]
        engine: a key of `ENGINES`
        near: as in `rasterize`

    Returns:
        Σ w·m, Σ m, Σ w and n over the pixels that the Gaussian contributes to; w = αT. [N,4]; no gradients
    """
    if tuple(mask.shape) != (camera.height, camera.width):
        raise ValueError(f"mask has shape {list(mask.shape)}, expected [{camera.height}, {camera.width}]")
    activated = ActivatedGaussians(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh
    )
    window = (0, 0, camera.width, camera.height)
    view = RasterView(
        camera.viewmat, camera.K, camera.width, camera.height, window, near, None, gaussians.antialiased
    )
    with torch.no_grad():
        return get_engine(engine).alpha_weights(activated, view, mask)


def _check_shapes(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    sh_degree: int | None,
) -> None:
    n = means.shape[0] if means.ndim else 0
    expected = {
        "means": (means, (n, 3)),
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "opacities": (opacities, (n,)),
        "viewmat": (viewmat, (4, 4)),
        "K": (K, (3, 3)),
    }
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape:
            raise ValueError(
                f"{name} has shape {list(tensor.shape)}, expected {list(shape)} (N={n} from means)"
            )
    if sh_degree is None:
        if colors.shape != (n, 3):
            raise ValueError(f"colors has shape {list(colors.shape)}, expected [{n}, 3] (rgb)")
        return
    if not 0 <= sh_degree <= 3:
        raise ValueError(f"sh_degree is {sh_degree}, expected 0 to 3")
    bands = (sh_degree + 1) ** 2
    if colors.ndim != 3 or colors.shape[0] != n or colors.shape[1] < bands or colors.shape[2] != 3:
        raise ValueError(
            f"colors has shape {list(colors.shape)}, expected [{n}, ≥{bands}, 3] for SH degree {sh_degree}"
        )


def _resolve_crop(crop: Crop | None, width: int, height: int) -> Crop:
    if width < 1 or height < 1:
        raise ValueError(f"the image is {width}x{height} pixels; both must be at least 1")
    if crop is None:
        return (0, 0, width, height)
    x0, y0, x1, y1 = (int(value) for value in crop)
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise ValueError(f"crop {(x0, y0, x1, y1)} is empty or leaves the image of {width}x{height} pixels")
    return (x0, y0, x1, y1)
