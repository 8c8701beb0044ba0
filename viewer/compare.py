"""Original and edited in one picture: side by side at a divider, or their difference amplified, with PSNR.

The original is drawn by a second engine without edits, made when it is first asked for: a slider then moves
only one of the two pictures, the divider neither.
"""

from __future__ import annotations

import math
from dataclasses import replace

import moderngl
import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from progdf.camera import Camera

from .engine import Engine, FrameTimings, drawn_size
from .film import Pixels, to_pixels
from .gl.present import Presenter
from .painters import Image
from .state import Comparison, ViewState

MODES = ("off", "split", "difference")
LEFT, RIGHT = "original", "edited"
MOST_AMPLIFIED = 64.0
_SHADE, _INK = (22, 24, 27), (222, 225, 230)


class Comparer:
    """Draws a view as its `compare` asks, in place of the engine.

    Args:
        engine: draws the edited scene; stays the caller's
        ctx: the engine's context; None for `image` only
    """

    def __init__(self, engine: Engine, ctx: moderngl.Context | None) -> None:
        self.engine = engine
        self.psnr = math.nan
        """Of the last difference or `image`, dB; infinite where nothing differs."""
        self._ctx = ctx
        self._original: Engine | None = None
        self._presenter: Presenter | None = None
        self._texture: moderngl.Texture | None = None
        self._shown: float | None = None  # how much the difference in the texture is amplified

    def needs_draw(self, view: ViewState, size: tuple[int, int], pixels: int = 1) -> bool:
        """Whether splats have to be drawn for `view`, or a difference taken; arguments as for `draw`."""
        drawn = size if view.compare.mode == "difference" else drawn_size(size, pixels)
        if self.engine.needs_draw(view, drawn):
            return True
        if view.compare.mode == "off":
            return False
        apart = view.compare.mode == "difference" and self._shown != view.compare.amplify
        return apart or self._second().needs_draw(_untouched(view), drawn)

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
        if view.compare.mode == "split":
            return self._draw_split(view, framebuffer, size, pixels)
        if view.compare.mode == "difference":
            return self._draw_difference(view, framebuffer, size)
        return self.engine.draw(view, framebuffer, size, pixels)

    def image(self, view: ViewState, size: tuple[int, int] = (0, 0), camera: Camera | None = None) -> Image:
        """The same as an array, without labels. [H,W,3] float32, see `Engine.image`"""
        if view.compare.mode == "off":
            return self.engine.image(view, size, camera)
        edited = self.engine.image(view, size, camera)
        original = self._second().image(_untouched(view), size, camera)
        self.psnr = _psnr(original, edited)
        if view.compare.mode == "split":
            at = column(view.compare, edited.shape[1])
            return np.concatenate([original[:, :at], edited[:, at:]], axis=1)
        return difference(original, edited, view.compare.amplify)

    def release(self) -> None:
        """Give back all but the engine."""
        for held in (self._original, self._presenter, self._texture):
            if held is not None:
                held.release()

    def _second(self) -> Engine:
        if self._original is None:
            self._original = Engine(self._ctx, self.engine.scene, (), self.engine.draws_with)
        return self._original

    def _draw_split(
        self, view: ViewState, framebuffer: moderngl.Framebuffer, size: tuple[int, int], pixels: int
    ) -> FrameTimings:
        at = column(view.compare, size[0])
        edited = self.engine.draw(view, framebuffer, size, pixels)
        framebuffer.scissor = (0, 0, at, size[1])
        try:
            original = self._second().draw(_untouched(view), framebuffer, size, pixels)
        finally:
            framebuffer.scissor = None  # type: ignore[assignment]  # its annotation forgets None
        return _together(edited, original)

    def _draw_difference(
        self, view: ViewState, framebuffer: moderngl.Framebuffer, size: tuple[int, int]
    ) -> FrameTimings:
        assert self._ctx is not None, "nothing to show on without a context"
        if self.needs_draw(view, size) or self._texture is None:
            apart = np.ascontiguousarray(self.image(view, size), np.float32)
            if self._texture is None or self._texture.size != size:
                if self._texture is not None:
                    self._texture.release()
                self._texture = self._ctx.texture(size, 3, dtype="f4")
            self._texture.write(apart)
            self._shown = view.compare.amplify
            timings = _together(self.engine.timings, self._second().timings)
        else:
            timings = FrameTimings(drawn=self.engine.timings.drawn)
        self._presenter = self._presenter or Presenter(self._ctx)
        self._presenter.show(self._texture, framebuffer)
        return timings


def column(compare: Comparison, width: int) -> int:
    """Where in a picture of this width the edited side begins, pixels."""
    return max(0, min(width, round(compare.divider * width)))


def difference(original: Image, edited: Image, amplify: float) -> Image:
    """amplify · |edited − original| of what is seen (0..1) of each; black where nothing differs. [H,W,3]"""
    apart: Image = np.abs(np.clip(edited, 0.0, 1.0) - np.clip(original, 0.0, 1.0)) * np.float32(amplify)
    return apart


def told(compare: Comparison, decibels: float) -> str:
    """The line over a difference."""
    if math.isinf(decibels):
        return "difference: none"
    return f"difference × {compare.amplify:g} · PSNR {decibels:.1f} dB"


def labelled(image: Image, compare: Comparison, decibels: float) -> Pixels:
    """A picture of `Comparer.image` for a file: with the divider and what is on which side."""
    pixels = to_pixels(image)
    if compare.mode == "off":
        return pixels
    page = Pillow.fromarray(pixels)
    draw = ImageDraw.Draw(page, "RGBA")
    if compare.mode == "difference":
        line = told(compare, decibels).replace("×", "x")  # Pillow's own font has no ×
        _tag(draw, page.width / 2, "m", line, page.size)
    else:
        at = column(compare, page.width)
        draw.line([(at, 0), (at, page.height)], (*_SHADE, 140), 3)
        draw.line([(at, 0), (at, page.height)], (255, 255, 255, 255), 1)
        _tag(draw, at, "r", LEFT, page.size)
        _tag(draw, at, "l", RIGHT, page.size)
    return np.asarray(page)


def switched(view: ViewState, mode: str) -> ViewState:
    """`mode` on, or off where it was on."""
    mode = "off" if view.compare.mode == mode else mode
    return replace(view, compare=replace(view.compare, mode=mode))


def _tag(draw: ImageDraw.ImageDraw, x: float, side: str, text: str, size: tuple[int, int]) -> None:
    """A word at the top: left of x ("r" as it ends there), right of it ("l"), or around it; where it fits."""
    letters = max(11, round(size[1] / 28))
    font = ImageFont.load_default(size=letters)
    wide, pad, gap = draw.textlength(text, font), 0.5 * letters, 0.6 * letters
    left = {"r": x - gap - wide - 2 * pad, "l": x + gap, "m": x - wide / 2 - pad}[side]
    if left < 0 or left + wide + 2 * pad > size[0]:
        return
    box = (left, gap, left + wide + 2 * pad, gap + 1.6 * letters)
    draw.rounded_rectangle(box, 0.3 * letters, (*_SHADE, 200))
    draw.text((left + pad, gap + 0.8 * letters), text, _INK, font, anchor="lm")


def _untouched(view: ViewState) -> ViewState:
    return replace(view, layers=())


def _psnr(original: Image, edited: Image) -> float:
    """As `progdf.metrics.psnr`, of what is seen, dB; without its copies in float64: a hand waits for it."""
    apart = difference(original, edited, 1.0).ravel()
    error = float(np.square(apart, out=apart).mean(dtype=np.float64)) if apart.size else 0.0
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def _together(edited: FrameTimings, original: FrameTimings) -> FrameTimings:
    """The time that both took, the figures of the edited one."""
    return replace(
        edited,
        compose_ms=edited.compose_ms + original.compose_ms,
        upload_ms=edited.upload_ms + original.upload_ms,
        sort_ms=edited.sort_ms + original.sort_ms,
        draw_ms=edited.draw_ms + original.draw_ms,
    )
