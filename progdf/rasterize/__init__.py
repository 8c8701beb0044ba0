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
from typing import NamedTuple

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians

from .conventions import RasterInfo
from .cpu.parallel import set_threads
from .engines import ENGINES, ActivatedGaussians, Crop, RasterView, activate, get_engine

__all__ = [
    "ENGINES",
    "ActivatedGaussians",
    "Crop",
    "RasterInfo",
    "Rendering",
    "activate",
    "alpha_weights",
    "render",
    "set_threads",
]


class Rendering(NamedTuple):
    """A scene as a camera sees it.

    Args:
        image: rgb, 0..1 as far as the colors are; not clamped. [H,W,3]
        transmittance: share of the background that shines through, 0..1. [H,W]
        info: what the projection found

    H and W are those of the window where there is a crop.
    """

    image: Tensor
    transmittance: Tensor
    info: RasterInfo


def render(
    gaussians: Gaussians | ActivatedGaussians,
    camera: Camera,
    background: Tensor | Sequence[float] = (1.0, 1.0, 1.0),
    *,
    colors: Tensor | None = None,
    crop: Crop | None = None,
    grad_rows: Tensor | None = None,
    engine: str = "cpu",
) -> Rendering:
    """Draw a scene (Kerbl et al. 2023), differentiable in every floating tensor it is given.

    Args:
        gaussians: raw parameters, or activated ones, which gradients then are to; of spherical harmonics the
            bands 0 to 3 are shown. A scene that was trained anti-aliased is drawn so
        camera: the view, and the depth at and below which nothing is drawn
        background: rgb behind everything. [3]
        colors: take the place of the Gaussians' own: rgb [N,3], or SH coefficients [N,K,3]
        crop: draw only this window, with the full image's conventions; equals the slice of the full image
            bit for bit. Gaussians that do not touch it cost next to nothing
        grad_rows: only these rows get gradients, all others zero; takes much less time where they are few.
            [M] int64
        engine: a key of `ENGINES`; "cpu" computes in float32 (projection in float64) whatever the inputs'
            type

    Returns:
        Image, transmittance and what the projection found: float32 of "cpu", of "reference" the means' type.

    Raises:
        ValueError: a shape does not fit, the crop is empty or leaves the image, the engine is unknown,
            `grad_rows` are given although the camera wants gradients, which need all rows.
        ProgdfError: more (Gaussian, tile) pairs than memory should hold.
    """
    if isinstance(gaussians, Gaussians):
        activated = activate(gaussians, colors)
    else:
        activated = gaussians if colors is None else gaussians._replace(colors=colors)
    _check_shapes(activated)
    _check_crop(crop, camera)
    if grad_rows is not None and (camera.viewmat.requires_grad or camera.K.requires_grad):
        raise ValueError("grad_rows are given, but viewmat or K wants gradients, which need all rows")
    if not isinstance(background, Tensor):
        background = torch.tensor(background, dtype=activated.means.dtype)
    if tuple(background.shape) != (3,):
        raise ValueError(f"background has shape {list(background.shape)}, expected [3]")
    view = RasterView.of(camera, activated, crop)
    return Rendering(*get_engine(engine).rasterize(activated, view, background, grad_rows))


def alpha_weights(gaussians: Gaussians, camera: Camera, mask: Tensor, engine: str = "cpu") -> Tensor:
    """What each Gaussian contributes to a view, inside a mask and in all (docs/method.md 4).

    Args:
        gaussians: raw parameters
        camera: the view
        mask: 0..1 or bool, of the camera's size. [H,W]
        engine: a key of `ENGINES`

    Returns:
        Σ w·m, Σ m, Σ w and n over the pixels that the Gaussian contributes to; w = αT. [N,4]; no gradients
    """
    if tuple(mask.shape) != (camera.height, camera.width):
        raise ValueError(f"mask has shape {list(mask.shape)}, expected [{camera.height}, {camera.width}]")
    activated = activate(gaussians, torch.zeros_like(gaussians.means))
    with torch.no_grad():
        return get_engine(engine).alpha_weights(activated, RasterView.of(camera, activated), mask)


def _check_shapes(gaussians: ActivatedGaussians) -> None:
    means, quats, scales, opacities, colors = gaussians.tensors
    n = means.shape[0] if means.ndim else 0
    expected = {
        "means": (means, (n, 3)),
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "opacities": (opacities, (n,)),
    }
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape:
            raise ValueError(
                f"{name} has shape {list(tensor.shape)}, expected {list(shape)} (N={n} from means)"
            )
    harmonics = colors.ndim == 3 and colors.shape[1] in (1, 4, 9, 16, 25)
    if colors.shape[:1] != (n,) or colors.shape[-1] != 3 or not (colors.ndim == 2 or harmonics):
        raise ValueError(
            f"colors has shape {list(colors.shape)}, expected [{n}, 3] (rgb) or [{n}, K, 3] with K one of "
            "1, 4, 9, 16, 25 (spherical harmonics)"
        )


def _check_crop(crop: Crop | None, camera: Camera) -> None:
    if crop is None:
        return
    x0, y0, x1, y1 = crop
    if not (0 <= x0 < x1 <= camera.width and 0 <= y0 < y1 <= camera.height):
        raise ValueError(f"crop {crop} is empty or leaves the image of {camera.width}x{camera.height} pixels")
