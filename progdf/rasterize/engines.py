"""Rendering of images and depth: the conventions, and the engines behind one signature.

    depth = Σ w z / Σ w,  alpha = Σ w,  w = αT,  z: camera z of a Gaussian's center

The depth is the expected depth, gsplat's "ED". Where one surface covers half of another, it lies between the
two. Depth has no kernel of its own: the scene gets the colors (z, 1, 0) and is drawn on black. So depth has
the weights of the image, whichever engine draws.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from math import isqrt
from typing import NamedTuple, Protocol, cast

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError, check_first_argument
from progdf.gaussians import Gaussians
from progdf.sh import rgb_to_sh0
from progdf.system.equality import equal_fields

DILATION = 0.3
"""Blur added to the diagonal of the 2D covariance, px² (Kerbl 2023, gsplat)."""

ALPHA_MAX = 0.99
"""Upper limit of alpha. The gradient of a clamped alpha is zero (Kerbl 2023)."""

ALPHA_MIN = 1.0 / 255.0
"""Lower limit of alpha. A Gaussian contributes to a pixel exactly if its alpha is at least this."""

TRANSMITTANCE_MIN = 1e-4
"""Lower limit of the transmittance.

A Gaussian that would reduce the transmittance to this or less is omitted, and the pixel is done.
"""

FRUSTUM_MARGIN = 0.3
"""Margin of x/z and y/z in the Jacobian beyond the frustum on each side, as a share of tan(fov/2)."""

ANTIALIAS_FLOOR = 0.005
"""Minimum of det(before dilation) / det(after) in the antialiasing factor, which is its square root."""

Crop = tuple[int, int, int, int]
"""Window x0, y0, x1, y1 in pixels of the full image; x1 and y1 are one past the last."""

ENGINES = {
    "reference": "progdf.rasterize.reference",
    "cpu": "progdf.rasterize.cpu.engine",
    "warp": "progdf.rasterize.warp_engine",
}
"""Name of an engine → module that implements `RasterEngine`, imported on first use."""

MAX_INTERSECTIONS = 100_000_000
"""Maximum number of (Gaussian, tile) pairs in a view: 1.2 GB forward, 3.6 GB more backward."""

_RENDERED_SH = 16  # SH coefficients that are drawn; a non-finite one hides its Gaussian


class ActivatedGaussians(NamedTuple):
    """N Gaussians in activated units, the input of the engines."""

    means: Tensor  # centers, world units. [N,3]
    quats: Tensor  # rotations wxyz, any nonzero length. [N,4]
    scales: Tensor  # standard deviations, world units, ≥ 0. [N,3]
    opacities: Tensor  # 0..1. [N]
    colors: Tensor  # rgb [N,3], or SH coefficients [N,K,3], K = (degree+1)²
    antialiased: bool = False  # scale opacities by sqrt(det/dilated det) of the 2D covariance (Mip-Splatting)

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Tensors without the flag."""
        return self[:5]

    @property
    def sh_degree(self) -> int | None:
        """SH degree that is drawn, 0..3; None for rgb colors."""
        return None if self.colors.ndim == 2 else min(isqrt(self.colors.shape[1]) - 1, 3)

    def each(self, function: Callable[[Tensor], Tensor]) -> ActivatedGaussians:
        """Return a copy with a function applied to every tensor."""
        means, quats, scales, opacities, colors = map(function, self.tensors)
        return ActivatedGaussians(means, quats, scales, opacities, colors, self.antialiased)

    def select(self, rows: Tensor) -> ActivatedGaussians:
        """Return a selection of the Gaussians. rows: [M] int64"""
        return self.each(lambda tensor: tensor[rows])


def activate(gaussians: Gaussians, colors: Tensor | None = None) -> ActivatedGaussians:
    """Return raw Gaussians in activated units.

    Args:
        gaussians: raw parameters
        colors: replaces the Gaussians' own spherical harmonics
    """
    colors = gaussians.sh if colors is None else colors
    return ActivatedGaussians(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors, gaussians.antialiased
    )


@dataclass(frozen=True)
class RasterView:
    """Camera and the window to draw of its image; see `progdf.rasterize.render`."""

    __eq__ = equal_fields

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    crop: Crop
    near: float = 0.01
    sh_degree: int | None = None
    antialiased: bool = False
    dilation: float = DILATION  # added to the diagonal of the 2D covariance, pixels²

    @classmethod
    def of(cls, camera: Camera, gaussians: ActivatedGaussians, crop: Crop | None = None) -> RasterView:
        """Return the view of `gaussians` from `camera`. Without a crop it is the whole image."""
        width = camera.width
        height = camera.height
        viewmat, K = (matrix.to(gaussians.means.device) for matrix in (camera.viewmat, camera.K))
        return cls(
            viewmat, K, width, height, crop or (0, 0, width, height), camera.near, gaussians.sh_degree,
            antialiased=gaussians.antialiased, dilation=DILATION / camera.sampling**2,
        )  # fmt: skip


class ColorMap(Protocol):
    """Blending weights αT of M Gaussians in the pixels of a window. They are valid while no Gaussian moves.

    Images are [h,w,3] for a whole window, [P,3] for selected pixels.
    """

    def picture(self, colors: Tensor) -> Tensor:
        """Return Σ αT·c of every pixel, on black, for any number of channels. [M,C] -> [h,w,C] or [P,C]"""
        ...

    def gradient(self, image: Tensor) -> Tensor:
        """Return the transpose, Σ αT·g of every Gaussian. [h,w,3] or [P,3] -> [M,3]"""
        ...


class RasterEngine(Protocol):
    """Interface of an engine. The shapes of all arguments have been checked."""

    def rasterize(
        self, gaussians: ActivatedGaussians, view: RasterView, background: Tensor, grad_rows: Tensor | None
    ) -> tuple[Tensor, Tensor, RasterInfo]:
        """Draw an image, see `progdf.rasterize.render`."""
        ...

    def alpha_weights(self, gaussians: ActivatedGaussians, view: RasterView, mask: Tensor) -> Tensor:
        """Sum blending weights, see `progdf.rasterize.alpha_weights`. Colors are not read."""
        ...

    def color_map(
        self, gaussians: ActivatedGaussians, view: RasterView, rows: Tensor, pixels: Tensor | None,
        lost: float,
    ) -> ColorMap:  # fmt: skip
        """Compute a color map, see `color_map`. Colors are not read."""
        ...


def choose_engine(name: str) -> str:
    """Return the engine for a name. "auto" is warp if a CUDA device and Warp are available, else cpu."""
    if name != "auto":
        return name
    has_gpu = torch.cuda.is_available() and find_spec("warp") is not None
    return "warp" if has_gpu else "cpu"


def engine_device(name: str) -> torch.device:
    """Return the device on which an engine needs its Gaussians: CUDA for warp if available, else the CPU."""
    return torch.device("cuda" if name == "warp" and torch.cuda.is_available() else "cpu")


@cache
def get_engine(name: str) -> RasterEngine:
    """Return the engine with this name.

    Raises:
        ValueError: no engine has this name.
    """
    if name not in ENGINES:
        raise ValueError(f"unknown rasterizer '{name}'; use one of {', '.join(ENGINES)}")
    return cast(RasterEngine, importlib.import_module(ENGINES[name]))


@dataclass(frozen=True)
class RasterInfo:
    """Results of the projection, not differentiable."""

    __eq__ = equal_fields

    means2d: Tensor  # centers in pixels; 0 if not finite or not beyond the near plane. [N,2]
    depths: Tensor  # camera z, world units; 0 likewise. [N] float32
    visible: Tensor  # true if the box around {alpha ≥ 1/255} touches the rendered window. [N] bool


class Rendering(NamedTuple):
    """Rendered view of a scene. H and W are the window's if there is a crop."""

    image: Tensor  # rgb, not clamped; 0..1 if the colors are. [H,W,3]
    transmittance: Tensor  # visible share of the background, 0..1. [H,W]
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
    """Draw a scene (Kerbl et al. 2023), differentiable in every floating tensor argument.

    Args:
        gaussians: raw parameters, or activated ones, which then receive the gradients. SH bands 0 to 3 are
            drawn. A scene trained with antialiasing is drawn with it
        camera: the view. Nothing is drawn at or below its near depth
        background: rgb behind everything. [3]
        colors: replace the Gaussians' own: rgb [N,3], or SH coefficients [N,K,3]
        crop: draw only this window, with the full image's conventions. It equals the slice of the full image
            bit for bit. Gaussians that do not touch it cost next to nothing
        grad_rows: rows that get gradients; all others get zeros. This takes much less time for a small number
            of rows. [M] int64
        engine: a key of `ENGINES`. All but "reference" compute in float32 (projection in float64) whatever
            the type of the inputs. "warp" runs on the device of the inputs

    Returns:
        Image, transmittance and results of the projection, in the type of the means for "reference", else
        float32.

    Raises:
        ValueError: a shape does not fit, the crop is empty or leaves the image, the engine is unknown, or
            `grad_rows` are given although the camera needs gradients, which depend on all rows.
        ProgdfError: there are more than `MAX_INTERSECTIONS` (Gaussian, tile) pairs.
    """
    check_first_argument("render(scene, camera)", gaussians, (Gaussians, ActivatedGaussians))
    activated = activate(gaussians, colors) if isinstance(gaussians, Gaussians) else gaussians
    if colors is not None:
        activated = activated._replace(colors=colors)
    _check_shapes(activated)
    _check_crop(crop, camera)
    if grad_rows is not None and (camera.viewmat.requires_grad or camera.K.requires_grad):
        raise ValueError("grad_rows cannot be combined with gradients of viewmat or K, which need all rows")
    if not isinstance(background, Tensor):
        background = torch.tensor(background, dtype=activated.means.dtype)
    if tuple(background.shape) != (3,):
        raise ValueError(f"background has shape {list(background.shape)}, expected [3]")
    view = RasterView.of(camera, activated, crop)
    return Rendering(*get_engine(engine).rasterize(activated, view, background, grad_rows))


def alpha_weights(gaussians: Gaussians, camera: Camera, mask: Tensor, engine: str = "cpu") -> Tensor:
    """Return each Gaussian's blending weights in a view, inside a mask and in total (docs/method.md 4).

    Args:
        gaussians: raw parameters
        camera: the view
        mask: 0..1 or bool, of the camera's size. [H,W]
        engine: a key of `ENGINES`

    Returns:
        Σ w·m, Σ m, Σ w and n over the pixels to which the Gaussian contributes; w = αT. [N,4], no gradients

    Raises:
        ValueError: the mask has another size.
    """
    if tuple(mask.shape) != (camera.height, camera.width):
        raise ValueError(f"mask has shape {list(mask.shape)}, expected [{camera.height}, {camera.width}]")
    activated = activate(gaussians, torch.zeros_like(gaussians.means))
    with torch.no_grad():
        return get_engine(engine).alpha_weights(activated, RasterView.of(camera, activated), mask)


def bare_weight(opacities: Tensor) -> Tensor:
    """Return the mean α of unoccluded Gaussians over the ellipse {α ≥ 1/255}. [N] -> [N]"""
    bare = (opacities - ALPHA_MIN) / (opacities / ALPHA_MIN).clamp_min(1.001).log()
    return bare.clamp_min(1e-6)


def color_map(
    gaussians: ActivatedGaussians,
    camera: Camera,
    crop: Crop,
    rows: Tensor,
    engine: str = "cpu",
    pixels: Tensor | None = None,
    lost: float = 0.0,
) -> ColorMap:
    """Return the blending weights of some Gaussians in a window of a view, as `render` draws it.

    Args:
        gaussians: all N Gaussians of the scene; their colors are not read
        camera: the view
        crop: x0, y0, x1, y1 of the window
        rows: rows of the M Gaussians, distinct. [M] int64
        engine: a key of `ENGINES`
        pixels: pixels of the window, in row-major order, ascending; None selects all. [P] int64
        lost: total weight per pixel that may be omitted if that is faster. Above 0, weights may also be
            rounded to 16 bits
    """
    black = gaussians._replace(colors=torch.zeros_like(gaussians.means))
    return get_engine(engine).color_map(black, RasterView.of(camera, black, crop), rows, pixels, lost)


def check_intersections(splats: int, pairs: int) -> None:
    """Refuse a view with more than `MAX_INTERSECTIONS` (Gaussian, tile) pairs.

    Raises:
        ProgdfError: the view has more.
    """
    if pairs > MAX_INTERSECTIONS:
        raise ProgdfError(
            f"{splats} Gaussians cover {pairs} tiles of the image, expected at most {MAX_INTERSECTIONS}; "
            "draw a smaller image or a crop, or remove giant Gaussians from the scene"
        )


def _check_shapes(gaussians: ActivatedGaussians) -> None:
    colors = gaussians.colors
    n = gaussians.means.shape[0] if gaussians.means.ndim else 0
    expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
    for name, shape in expected.items():
        tensor = getattr(gaussians, name)
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


class Depth(NamedTuple):
    """Result of `render_depth`."""

    depth: Tensor  # camera z, world units; 0 where nothing is drawn. [H,W]
    alpha: Tensor  # 1 − transmittance, 0..1. [H,W]


def render_depth(
    gaussians: Gaussians, camera: Camera, engine: str = "cpu", crop: Crop | None = None
) -> Depth:
    """Draw the depth of a scene, differentiable like the image. Arguments as in `progdf.render`."""
    painted = paint_depth(gaussians, camera)
    return depth_of(render(painted, camera, (0.0, 0.0, 0.0), crop=crop, engine=engine).image)


def paint_depth(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Return the scene in the colors (camera z, 1, 0). Draw it on black from this camera with any engine."""
    viewmat = camera.viewmat.to(gaussians.means.device).double()
    z = (gaussians.means.double() @ viewmat[2, :3] + viewmat[2, 3]).to(gaussians.means)
    colors = torch.stack([z, torch.ones_like(z), torch.zeros_like(z)], dim=1)
    finite = gaussians.sh[:, :_RENDERED_SH].isfinite().flatten(1).all(1)
    sh0 = torch.where(finite[:, None], rgb_to_sh0(colors), torch.nan)
    return replace(gaussians, sh0=sh0, shN=gaussians.shN[:, :0])


def depth_of(image: Tensor) -> Depth:
    """Return the depth in an image of a scene painted by `paint_depth`. [H,W,≥2]"""
    weighted = image[..., 0]
    alpha = image[..., 1]
    drawn = alpha > 0
    return Depth(torch.where(drawn, weighted / torch.where(drawn, alpha, 1.0), 0.0), alpha)
