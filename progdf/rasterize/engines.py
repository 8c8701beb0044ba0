"""Drawing a scene and its depth: the conventions, and the engines behind one signature.

    depth = Σ w z / Σ w,  alpha = Σ w,  w = αT,  z: camera z of a Gaussian's center

The expected depth, as gsplat's "ED": of a surface half covered by another it lies between the two. There is
no kernel of its own: the scene is painted with (z, 1, 0) and drawn on black, so the depth has the picture's
weights, whichever engine draws.
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

DILATION = 0.3
"""Added to the diagonal of the 2D covariance, px² (Kerbl 2023, gsplat)."""

ALPHA_MAX = 0.99
"""Alpha is clamped here; where it is, its gradient is zero (Kerbl 2023)."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian contributes to a pixel exactly where its alpha is at least this."""

TRANSMITTANCE_MIN = 1e-4
"""A Gaussian that would bring the transmittance to this or below is left out, and the pixel is done."""

FRUSTUM_MARGIN = 0.3
"""x/z and y/z in the Jacobian are clamped to the frustum plus this share of tan(fov/2) on each side."""

ANTIALIAS_FLOOR = 0.005
"""Least det(before dilation) / det(after) that the antialias option takes the root of."""

Crop = tuple[int, int, int, int]
"""A window x0, y0, x1, y1 in pixels of the full image; x1 and y1 are one past the last."""

ENGINES = {
    "reference": "progdf.rasterize.reference",
    "cpu": "progdf.rasterize.cpu.engine",
    "warp": "progdf.rasterize.warp_engine",
}
"""Engine name -> module that is a `RasterEngine`, imported when first used."""

MAX_INTERSECTIONS = 100_000_000
"""(Gaussian, tile) pairs beyond which a view is refused: 1.2 GB forward, 3.6 GB more backward."""

_DRAWN_SH = 16  # coefficients that a picture shows; one that is not finite hides its Gaussian


class ActivatedGaussians(NamedTuple):
    """N Gaussians in activated units, as they are drawn."""

    means: Tensor  # centers, world units. [N,3]
    quats: Tensor  # rotations wxyz, any nonzero length. [N,4]
    scales: Tensor  # standard deviations, world units, ≥ 0. [N,3]
    opacities: Tensor  # 0..1. [N]
    colors: Tensor  # rgb [N,3], or spherical-harmonic coefficients [N,K,3], K = (degree+1)²
    antialiased: bool = False  # scale opacities by sqrt(det/dilated det) of the 2D covariance (Mip-Splatting)

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """All but the flag."""
        return self[:5]

    @property
    def sh_degree(self) -> int | None:
        """Degree of the harmonics that are shown, 0..3; None where the colors are rgb."""
        return None if self.colors.ndim == 2 else min(isqrt(self.colors.shape[1]) - 1, 3)

    def each(self, function: Callable[[Tensor], Tensor]) -> ActivatedGaussians:
        """The same with every tensor passed through a function."""
        means, quats, scales, opacities, colors = map(function, self.tensors)
        return ActivatedGaussians(means, quats, scales, opacities, colors, self.antialiased)

    def select(self, rows: Tensor) -> ActivatedGaussians:
        """Some of them. [M] int64"""
        return self.each(lambda tensor: tensor[rows])


def activate(gaussians: Gaussians, colors: Tensor | None = None) -> ActivatedGaussians:
    """Raw Gaussians in activated units, with their own spherical harmonics or, if given, other `colors`."""
    colors = gaussians.sh if colors is None else colors
    return ActivatedGaussians(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, colors, gaussians.antialiased
    )


@dataclass(frozen=True)
class RasterView:
    """A camera and what is drawn of its image; see `progdf.rasterize.render`."""

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
        """What `camera` sees of `gaussians`; of its whole image where there is no crop."""
        width = camera.width
        height = camera.height
        viewmat, K = (matrix.to(gaussians.means.device) for matrix in (camera.viewmat, camera.K))
        return cls(
            viewmat, K, width, height, crop or (0, 0, width, height), camera.near, gaussians.sh_degree,
            antialiased=gaussians.antialiased, dilation=DILATION / camera.sampling**2,
        )  # fmt: skip


class ColorMap(Protocol):
    """What each of M Gaussians weighs in each pixel of a window: αT, for as long as nothing moves.

    [h,w,3] of the whole window, [P,3] where it is of some pixels.
    """

    def picture(self, colors: Tensor) -> Tensor:
        """Σ αT·c of every pixel, on black, of any number of channels. [M,C] -> [h,w,C] or [P,C]"""
        ...

    def gradient(self, image: Tensor) -> Tensor:
        """The transpose: Σ αT·g of every Gaussian. [h,w,3] or [P,3] -> [M,3]"""
        ...


class RasterEngine(Protocol):
    """What draws; shapes have been checked."""

    def rasterize(
        self, gaussians: ActivatedGaussians, view: RasterView, background: Tensor, grad_rows: Tensor | None
    ) -> tuple[Tensor, Tensor, RasterInfo]:
        """See `progdf.rasterize.render`."""
        ...

    def alpha_weights(self, gaussians: ActivatedGaussians, view: RasterView, mask: Tensor) -> Tensor:
        """See `progdf.rasterize.alpha_weights`; colors are not read."""
        ...

    def color_map(
        self, gaussians: ActivatedGaussians, view: RasterView, rows: Tensor, pixels: Tensor | None,
        lost: float,
    ) -> ColorMap:  # fmt: skip
        """See `color_map`; colors are not read."""
        ...


def choose_engine(name: str) -> str:
    """The engine that "auto" is on this machine: warp where there is a card and it can draw, else cpu."""
    card = torch.cuda.is_available() and find_spec("warp") is not None
    return name if name != "auto" else "warp" if card else "cpu"


def engine_device(name: str) -> torch.device:
    """Where an engine should have its Gaussians: on the card, if there is one and it draws there."""
    return torch.device("cuda" if name == "warp" and torch.cuda.is_available() else "cpu")


@cache
def get_engine(name: str) -> RasterEngine:
    """The engine of that name."""
    if name not in ENGINES:
        raise ValueError(f"unknown rasterizer '{name}'; use one of {', '.join(ENGINES)}")
    return cast(RasterEngine, importlib.import_module(ENGINES[name]))


@dataclass(frozen=True)
class RasterInfo:
    """What the projection yields, not differentiable."""

    means2d: Tensor  # centers in pixels; 0 for a Gaussian not in front of the near plane or not finite. [N,2]
    depths: Tensor  # camera z, world units; 0 likewise. [N] float32
    visible: Tensor  # the box around its {alpha ≥ 1/255} touches the window that was rendered. [N] bool


class Rendering(NamedTuple):
    """A scene as a camera sees it. H and W are those of the window where there is a crop."""

    image: Tensor  # rgb, 0..1 as far as the colors are; not clamped. [H,W,3]
    transmittance: Tensor  # share of the background that shines through, 0..1. [H,W]
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
            bands 0 to 3 are drawn. A scene that was trained anti-aliased is drawn so
        camera: the view, and the depth at and below which nothing is drawn
        background: rgb behind everything. [3]
        colors: in place of the Gaussians' own: rgb [N,3], or SH coefficients [N,K,3]
        crop: draw only this window, with the full image's conventions; equals the slice of the full image
            bit for bit. Gaussians that do not touch it cost next to nothing
        grad_rows: only these rows get gradients, all others zero; takes much less time where they are few.
            [M] int64
        engine: a key of `ENGINES`; all but "reference" compute in float32 (projection in float64) whatever
            the inputs' type, "warp" on the device that they are on

    Returns:
        Image, transmittance and what the projection yields: of "reference" the means' type, else float32.

    Raises:
        ValueError: a shape does not fit, the crop is empty or leaves the image, the engine is unknown,
            `grad_rows` are given although the camera wants gradients, which need all rows.
        ProgdfError: more (Gaussian, tile) pairs than memory should hold.
    """
    check_first_argument("render(scene, camera)", gaussians, (Gaussians, ActivatedGaussians))
    activated = activate(gaussians, colors) if isinstance(gaussians, Gaussians) else gaussians
    if colors is not None:
        activated = activated._replace(colors=colors)
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


def color_map(
    gaussians: ActivatedGaussians,
    camera: Camera,
    crop: Crop,
    rows: Tensor,
    engine: str = "cpu",
    pixels: Tensor | None = None,
    lost: float = 0.0,
) -> ColorMap:
    """What some Gaussians weigh in a window of a view, as `render` draws it.

    Args:
        gaussians: all N that are drawn; their colors are not read
        camera: the view
        crop: x0, y0, x1, y1 of the window
        rows: which of the N Gaussians, distinct. [M] int64
        engine: a key of `ENGINES`
        pixels: which of the window's alone, numbered row by row, ascending; None: all. [P] int64
        lost: of each pixel's weights, in all, what may be left out where that is faster
    """
    black = gaussians._replace(colors=torch.zeros_like(gaussians.means))
    return get_engine(engine).color_map(black, RasterView.of(camera, black, crop), rows, pixels, lost)


def check_intersections(splats: int, pairs: int) -> None:
    """Refuse a view of more than `MAX_INTERSECTIONS` (Gaussian, tile) pairs.

    Raises:
        ProgdfError: it has more.
    """
    if pairs > MAX_INTERSECTIONS:
        raise ProgdfError(
            f"{splats} Gaussians meet {pairs} tiles of the image, more than {MAX_INTERSECTIONS}; draw a "
            "smaller image or a crop, or take giant Gaussians out of the scene"
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
    """What `render_depth` draws."""

    depth: Tensor  # camera z, world units; 0 where nothing is drawn. [H,W]
    alpha: Tensor  # 1 − transmittance, 0..1. [H,W]


def render_depth(
    gaussians: Gaussians, camera: Camera, engine: str = "cpu", crop: Crop | None = None
) -> Depth:
    """Draw the depth of a scene, differentiable as the picture is. Arguments as of `progdf.render`."""
    painted = paint_depth(gaussians, camera)
    return depth_of(render(painted, camera, (0.0, 0.0, 0.0), crop=crop, engine=engine).image)


def paint_depth(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The scene in the colors (camera z, 1, 0), to be drawn on black from this camera by any engine."""
    viewmat = camera.viewmat.to(gaussians.means.device).double()
    z = (gaussians.means.double() @ viewmat[2, :3] + viewmat[2, 3]).to(gaussians.means)
    colors = torch.stack([z, torch.ones_like(z), torch.zeros_like(z)], dim=1)
    finite = gaussians.sh[:, :_DRAWN_SH].isfinite().flatten(1).all(1)
    sh0 = torch.where(finite[:, None], rgb_to_sh0(colors), torch.nan)
    return replace(gaussians, sh0=sh0, shN=gaussians.shN[:, :0])


def depth_of(image: Tensor) -> Depth:
    """What a picture of a scene painted by `paint_depth` shows. [H,W,≥2]"""
    weighted = image[..., 0]
    alpha = image[..., 1]
    drawn = alpha > 0
    return Depth(torch.where(drawn, weighted / torch.where(drawn, alpha, 1.0), 0.0), alpha)
