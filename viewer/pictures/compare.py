"""Two pictures in one: each in a half, or split at a divider, or their difference amplified, with PSNR.

Beside the edited picture stands the original, or one snapshot beside another. That side is drawn by a second
engine, made when it is first asked for: against the original a slider then moves only one of the two
pictures, the divider neither.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import moderngl
import numpy as np
import torch
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from progdf.camera import Camera
from progdf.metrics.image import psnr
from viewer.camera.view_camera import half_camera, to_camera
from viewer.gl.present import Presenter
from viewer.render.dynamic_resolution import FrameTimings, drawn_size
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import Image
from viewer.state.snapshots import SnapshotSides
from viewer.state.view_state import Comparison, ViewState

from .film import Pixels, to_pixels

ORIGINAL = "original"
EDITED = "edited"
_SHADE = (22, 24, 27)
_INK = (222, 225, 230)
_PLAIN = str.maketrans({"×": "x", "–": "-"})  # Pillow's own font has no others


@dataclass(frozen=True)
class Labels:
    """The words of one comparison."""

    left: str = ORIGINAL  # left, right: the two sides
    right: str = EDITED
    line: str = ""  # over a difference


def labels(compare: Comparison, decibels: float, names: tuple[str, str] | None = None) -> Labels:
    """What to say over a comparison.

    Args:
        compare: what is compared, and how
        decibels: PSNR of the two pictures; NaN where it was not taken
        names: of the snapshots on the two sides; None for the original and the edited
    """
    if math.isinf(decibels):
        line = "difference: none"
        figure = " · no difference"
    else:
        figure = "" if math.isnan(decibels) else f" · PSNR {decibels:.1f} dB"
        line = f"difference × {compare.amplify:g}{figure}"
    if names is None:
        return Labels(line=line)
    return Labels(names[0], names[1] + figure, f"{line} · {names[0]} against {names[1]}")


def draw_labels(image: Image, compare: Comparison, words: Labels) -> Pixels:
    """A picture of `Comparer.image` for a file: with the divider and what is on which side."""
    pixels = to_pixels(image)
    if compare.mode == "off":
        return pixels
    page = Pillow.fromarray(pixels)
    draw = ImageDraw.Draw(page, "RGBA")
    if compare.mode == "difference":
        _tag(draw, page.width / 2, "m", words.line, page.size)
    else:
        at = column(compare, page.width)
        draw.line([(at, 0), (at, page.height)], (*_SHADE, 140), 3)
        draw.line([(at, 0), (at, page.height)], (255, 255, 255, 255), 1)
        _tag(draw, at, "r", words.left, page.size)
        _tag(draw, at, "l", words.right, page.size)
    return np.asarray(page)


def column(compare: Comparison, width: int) -> int:
    """Where in a picture of this width the edited side begins, pixels."""
    if compare.mode == "beside":
        return width // 2
    return max(0, min(width, round(compare.divider * width)))


def _tag(draw: ImageDraw.ImageDraw, x: float, side: str, text: str, size: tuple[int, int]) -> None:
    """A word at the top: left of x ("r" as it ends there), right of it ("l"), or around it; where it fits."""
    text = text.translate(_PLAIN)
    letters = max(11, round(size[1] / 28))
    font = ImageFont.load_default(size=letters)
    wide = draw.textlength(text, font)
    pad = 0.5 * letters
    gap = 0.6 * letters
    left = {"r": x - gap - wide - 2 * pad, "l": x + gap, "m": x - wide / 2 - pad}[side]
    if left < 0 or left + wide + 2 * pad > size[0]:
        return
    box = (left, gap, left + wide + 2 * pad, gap + 1.6 * letters)
    draw.rounded_rectangle(box, 0.3 * letters, (*_SHADE, 200))
    draw.text((left + pad, gap + 0.8 * letters), text, _INK, font, anchor="lm")


class Comparer:
    """Draws a view as its `compare` asks, in place of the engine.

    Args:
        engine: draws the edited scene; stays the caller's
        ctx: the engine's context; None for `image` only
    """

    def __init__(self, engine: ViewEngine, ctx: moderngl.Context | None) -> None:
        self.engine = engine
        self.psnr = math.nan
        """Of the last comparison, dB; infinite where nothing differs, NaN where it was not taken."""
        self.sides: SnapshotSides | None = None
        """The snapshots that the next view compares; that view is then `sides.right`."""
        self._ctx = ctx
        self._other: ViewEngine | None = None
        self._of_snapshots = False  # whether `_other` draws one of them
        self._presenter: Presenter | None = None
        self._texture: moderngl.Texture | None = None
        self._amplified: float | None = None  # how much the difference in the texture is amplified

    def needs_draw(self, view: ViewState, size: tuple[int, int], pixels: int = 1) -> bool:
        """Whether splats have to be drawn for `view`, or a difference taken; arguments as for `draw`."""
        drawn = size if view.compare.mode == "difference" else drawn_size(size, pixels)
        camera = half_camera(to_camera(view.camera, *drawn)) if view.compare.mode == "beside" else None
        if self.engine.needs_draw(view, drawn, camera):
            return True
        if view.compare.mode == "off":
            return False
        another = view.compare.mode == "difference" and self._amplified != view.compare.amplify
        return another or self._second().needs_draw(self._other_view(view), drawn, camera)

    def draw(
        self,
        view: ViewState,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int],
        pixels: int = 1,
    ) -> FrameTimings:
        """Show `view` in the lower left `size` pixels of `framebuffer`.

        Args:
            pixels: of the framebuffer that one drawn pixel fills, each way; a difference is drawn in full

        Raises:
            ProgdfError: a layer of `view` means nothing.
        """
        if view.compare.mode == "difference":
            return self._draw_difference(view, framebuffer, size)
        self._amplified = None  # the engines go on, and the next difference is another
        if view.compare.mode in ("beside", "split"):
            return self._draw_sides(view, framebuffer, size, pixels)
        return self.engine.draw(view, framebuffer, size, pixels)

    def prepare(self, view: ViewState, size: tuple[int, int]) -> bool:
        """Begin in full what was drawn coarsely; whether `draw` now shows it at once."""
        camera = to_camera(view.camera, *size)
        mode = view.compare.mode
        camera = half_camera(camera) if mode == "beside" else camera
        if not self.engine.prepare(view, camera):
            return False
        return mode == "off" or self._second().prepare(self._other_view(view), camera)

    def image(self, view: ViewState, size: tuple[int, int] = (0, 0), camera: Camera | None = None) -> Image:
        """The same as an array, without labels. [H,W,3] float32, see `ViewEngine.image`"""
        if view.compare.mode == "off":
            return self.engine.image(view, size, camera)
        if view.compare.mode == "beside":
            full = camera or to_camera(view.camera, *size)
            camera = half_camera(full)
        edited = self.engine.image(view, size, camera)
        other = self._second().image(self._other_view(view), size, camera)
        self.psnr = _psnr(other, edited)
        if view.compare.mode == "beside":
            gap = np.ones((edited.shape[0], full.width - 2 * edited.shape[1], 3), np.float32)
            return np.concatenate([other, edited, gap], axis=1)
        if view.compare.mode == "split":
            at = column(view.compare, edited.shape[1])
            return np.concatenate([other[:, :at], edited[:, at:]], axis=1)
        return difference(other, edited, view.compare.amplify)

    def labels(self, view: ViewState) -> Labels:
        """What to say over the last comparison, of `view`."""
        return labels(view.compare, self.psnr, self.sides.names if self.sides else None)

    def release(self) -> None:
        """Give back all but the engine."""
        for resource in (self._other, self._presenter, self._texture):
            if resource is not None:
                resource.release()

    def _second(self) -> ViewEngine:
        """What draws the other side."""
        if self._other is None or self._of_snapshots != bool(self.sides):
            if self._other is not None:
                self._other.release()
            self._of_snapshots = bool(self.sides)
            gdfs = self.engine.gdfs if self.sides else ()
            self._other = ViewEngine(self._ctx, self.engine.scene, gdfs, self.engine.draws_with)
        return self._other

    def _other_view(self, view: ViewState) -> ViewState:
        """What the other side of `view` shows."""
        if self.sides is None:
            return replace(view, layers=())
        left = self.sides.left
        return replace(view, layers=left.layers, groups=left.groups, blend=left.blend)

    def _draw_sides(
        self, view: ViewState, framebuffer: moderngl.Framebuffer, size: tuple[int, int], pixels: int
    ) -> FrameTimings:
        other = self._second()
        its_view = self._other_view(view)
        self.psnr = math.nan  # of no use: an edit shall differ
        if view.compare.mode == "beside":
            edited = self.engine.draw(view, framebuffer, size, pixels, half=1)
            original = other.draw(its_view, framebuffer, size, pixels, half=0)
        else:
            edited = self.engine.draw(view, framebuffer, size, pixels)
            framebuffer.scissor = (0, 0, column(view.compare, size[0]), size[1])
            try:
                original = other.draw(its_view, framebuffer, size, pixels)
            finally:
                framebuffer.scissor = None  # type: ignore[assignment]  # its annotation forgets None
        return _add_timings(edited, original)

    def _draw_difference(
        self, view: ViewState, framebuffer: moderngl.Framebuffer, size: tuple[int, int]
    ) -> FrameTimings:
        assert self._ctx is not None, "nothing to show on without a context"
        if self.needs_draw(view, size) or self._texture is None:
            image = np.ascontiguousarray(self.image(view, size), np.float32)
            if self._texture is None or self._texture.size != size:
                if self._texture is not None:
                    self._texture.release()
                self._texture = self._ctx.texture(size, 3, dtype="f4")
            self._texture.write(image)
            self._amplified = view.compare.amplify
            timings = _add_timings(self.engine.timings, self._second().timings)
        else:
            timings = FrameTimings(drawn=self.engine.timings.drawn)
        self._presenter = self._presenter or Presenter(self._ctx)
        self._presenter.show(self._texture, framebuffer)
        return timings


def difference(other: Image, edited: Image, amplify: float) -> Image:
    """amplify · |edited − other| of what is seen (0..1) of each; black where nothing differs. [H,W,3]"""
    image: Image = np.abs(np.clip(edited, 0.0, 1.0) - np.clip(other, 0.0, 1.0)) * np.float32(amplify)
    return image


def _psnr(other: Image, edited: Image) -> float:
    """Of what is seen (0..1) of two pictures, dB."""
    seen = (torch.from_numpy(np.clip(image, 0.0, 1.0)) for image in (edited, other))
    return psnr(*seen)


def _add_timings(edited: FrameTimings, original: FrameTimings) -> FrameTimings:
    """The time that both took, the figures of the edited one."""
    return replace(
        edited,
        compose_ms=edited.compose_ms + original.compose_ms,
        upload_ms=edited.upload_ms + original.upload_ms,
        sort_ms=edited.sort_ms + original.sort_ms,
        draw_ms=edited.draw_ms + original.draw_ms,
    )
