"""Comparison of two pictures: side by side, split at a divider, or their amplified difference, with PSNR.

The edited picture is compared with the original or with a photograph, or one snapshot with another. A second
engine draws the other side; it is created on first use. Against the original, a slider then redraws only one
of the two pictures, and the divider none.
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
from viewer.camera.photograph import Photograph, in_view
from viewer.camera.view_camera import half_camera, to_camera
from viewer.gl.present import Presenter
from viewer.render.dynamic_resolution import FrameTimings, drawn_size
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import Image
from viewer.render.view_modes import SPLATS
from viewer.state.snapshots import SnapshotSides
from viewer.state.view_state import Comparison, ViewState

from .film import Pixels, to_pixels

ORIGINAL = "original"
EDITED = "edited"
PHOTOGRAPH = "photograph"
SPLATS_NAME = "splats"
_SHADE = (22, 24, 27)
_INK = (222, 225, 230)
_FONT_REPLACEMENTS = str.maketrans({"×": "x", "–": "-"})  # Pillow's default font lacks these characters


@dataclass(frozen=True)
class Labels:
    """Labels of a comparison."""

    left: str = ORIGINAL  # left side
    right: str = EDITED  # right side
    line: str = ""  # label of a difference
    note: str = ""  # second line: the PSNR and the photograph's size; "" for none


def labels(compare: Comparison, decibels: float, names: tuple[str, str] | None = None) -> Labels:
    """Return the labels of a comparison.

    Args:
        compare: kind and settings of the comparison
        decibels: PSNR of the two pictures; NaN if it was not measured
        names: names of the two sides; None for the original and the edited
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
    """Return a picture of `Comparer.image` with the divider and the labels of its sides."""
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
    """Return the column where the edited side begins in a picture of this width, in pixels."""
    if compare.mode == "beside":
        return width // 2
    return max(0, min(width, round(compare.divider * width)))


def _tag(draw: ImageDraw.ImageDraw, x: float, side: str, text: str, size: tuple[int, int]) -> None:
    """Draw a label at the top if it fits: ending left of x ("r"), beginning right of it ("l"), or
    centered."""
    text = text.translate(_FONT_REPLACEMENTS)
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


@dataclass(eq=False)
class _Warped:
    """Photograph in a view, with its texture once it was shown."""

    key: object  # photograph and camera
    image: Image  # [H,W,3]
    shown: torch.Tensor  # pixels that the photograph shows. [H,W] bool
    texture: moderngl.Texture | None = None


def _warp_key(photograph: Photograph | None, camera: Camera) -> object:
    """Return a value that is equal for equal pictures of a photograph."""
    matrices = camera.viewmat.numpy().tobytes() + camera.K.numpy().tobytes()
    return photograph, matrices, camera.width, camera.height


class Comparer:
    """Renderer of a view with its comparison, used in place of the engine.

    Args:
        engine: draws the edited scene; owned by the caller
        ctx: context of the engine; None for `image` only
    """

    def __init__(self, engine: ViewEngine, ctx: moderngl.Context | None) -> None:
        self.engine = engine
        self.psnr = math.nan
        """PSNR of the last comparison, dB; infinite without a difference, NaN if it was not measured."""
        self.sides: SnapshotSides | None = None
        """Snapshots that the next view compares; that view is then `sides.right`."""
        self.photograph: Photograph | None = None
        """Photograph that the next view is compared with, taken from its eye; None for none."""
        self._ctx = ctx
        self._other: ViewEngine | None = None
        self._of_snapshots = False  # `_other` draws a snapshot
        self._presenter: Presenter | None = None
        self._texture: moderngl.Texture | None = None
        self._amplified: float | None = None  # amplification of the difference in the texture
        self._warped: _Warped | None = None  # the photograph in the last view
        self._measured: tuple[object, tuple[int, int]] | None = None  # photograph and size of `psnr`

    def needs_draw(self, view: ViewState, size: tuple[int, int], pixels: int = 1) -> bool:
        """Return whether `view` needs Gaussians drawn or a difference computed; arguments as for `draw`."""
        drawn = size if view.compare.mode == "difference" else drawn_size(size, pixels)
        camera = half_camera(to_camera(view.camera, *drawn)) if view.compare.mode == "beside" else None
        if self.engine.needs_draw(view, drawn, camera):
            return True
        if view.compare.mode == "off":
            return False
        if view.compare.mode == "difference" and self._amplified != view.compare.amplify:
            return True
        if self.photograph is not None:
            return view.compare.mode == "difference" and self._needs_warp(to_camera(view.camera, *drawn))
        return self._second().needs_draw(self._other_view(view), drawn, camera)

    def draw(
        self,
        view: ViewState,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int],
        pixels: int = 1,
    ) -> FrameTimings:
        """Show `view` in the lower left `size` pixels of `framebuffer`.

        Args:
            pixels: width and height in framebuffer pixels of one drawn pixel; a difference is drawn in full

        Raises:
            ProgdfError: `view` has an invalid layer.
        """
        if view.compare.mode == "difference":
            return self._draw_difference(view, framebuffer, size)
        self._amplified = None  # the engines draw new pictures, so the texture is outdated
        if view.compare.mode in ("beside", "split"):
            return self._draw_sides(view, framebuffer, size, pixels)
        return self.engine.draw(view, framebuffer, size, pixels)

    def prepare(self, view: ViewState, size: tuple[int, int]) -> bool:
        """Begin the full resolution of a coarsely drawn view; return whether `draw` can show it at once."""
        camera = to_camera(view.camera, *size)
        mode = view.compare.mode
        camera = half_camera(camera) if mode == "beside" else camera
        if not self.engine.prepare(view, camera):
            return False
        if mode == "off" or self.photograph is not None:
            return True
        return self._second().prepare(self._other_view(view), camera)

    def image(self, view: ViewState, size: tuple[int, int] = (0, 0), camera: Camera | None = None) -> Image:
        """Return the view as an array, without labels. [H,W,3] float32, see `ViewEngine.image`"""
        if view.compare.mode == "off":
            return self.engine.image(view, size, camera)
        if view.compare.mode == "beside":
            full = camera or to_camera(view.camera, *size)
            camera = half_camera(full)
        edited = self.engine.image(view, size, camera)
        if self.photograph is not None:
            warped = self._photograph_in(camera or to_camera(view.camera, *size))
            other = warped.image
            self._measure(edited, warped)
        else:
            other = self._second().image(self._other_view(view), size, camera)
            self.psnr = _psnr(other, edited)
        if view.compare.mode == "beside":
            gap = np.ones((edited.shape[0], full.width - 2 * edited.shape[1], 3), np.float32)
            return np.concatenate([other, edited, gap], axis=1)
        if view.compare.mode == "split":
            at = column(view.compare, edited.shape[1])
            return np.concatenate([other[:, :at], edited[:, at:]], axis=1)
        image = difference(other, edited, view.compare.amplify)
        if self.photograph is not None:
            image[~warped.shown.numpy()] = 0.0
        return image

    def labels(self, view: ViewState) -> Labels:
        """Return the labels of the last comparison, of `view`."""
        if view.compare.against != PHOTOGRAPH:
            return labels(view.compare, self.psnr, self.sides.names if self.sides else None)
        words = labels(view.compare, self.psnr, (PHOTOGRAPH, SPLATS_NAME))
        if self.photograph is None or self._measured is None or view.compare.mode == "off":
            return words
        figure = "" if math.isnan(self.psnr) else f"PSNR {self.psnr:.2f} dB at {{}} × {{}} · "
        return replace(words, note=figure.format(*self._measured[1]) + self.photograph.note)

    def release(self) -> None:
        """Release all resources except the engine."""
        texture = None if self._warped is None else self._warped.texture
        for resource in (self._other, self._presenter, self._texture, texture):
            if resource is not None:
                resource.release()

    def _second(self) -> ViewEngine:
        """Return the engine of the other side."""
        if self._other is None or self._of_snapshots != bool(self.sides):
            if self._other is not None:
                self._other.release()
            self._of_snapshots = bool(self.sides)
            gdfs = self.engine.gdfs if self.sides else ()
            self._other = ViewEngine(self._ctx, self.engine.scene, gdfs, self.engine.draws_with)
        return self._other

    def _other_view(self, view: ViewState) -> ViewState:
        """Return the view of the other side."""
        if self.sides is None:
            return replace(view, layers=())
        left = self.sides.left
        return replace(view, layers=left.layers, groups=left.groups, blend=left.blend)

    def _draw_sides(
        self, view: ViewState, framebuffer: moderngl.Framebuffer, size: tuple[int, int], pixels: int
    ) -> FrameTimings:
        if self.photograph is not None:
            return self._draw_beside_photograph(view, framebuffer, size, pixels)
        other = self._second()
        its_view = self._other_view(view)
        self.psnr = math.nan  # not needed: an edit is meant to differ
        if view.compare.mode == "beside":
            edited = self.engine.draw(view, framebuffer, size, pixels, half=1)
            original = other.draw(its_view, framebuffer, size, pixels, half=0)
        else:
            edited = self.engine.draw(view, framebuffer, size, pixels)
            framebuffer.scissor = (0, 0, column(view.compare, size[0]), size[1])
            try:
                original = other.draw(its_view, framebuffer, size, pixels)
            finally:
                framebuffer.scissor = None  # type: ignore[assignment]  # its annotation lacks None
        return _add_timings(edited, original)

    def _draw_beside_photograph(
        self, view: ViewState, framebuffer: moderngl.Framebuffer, size: tuple[int, int], pixels: int
    ) -> FrameTimings:
        """Draw the edited side and the photograph; measure the PSNR of a new picture at full resolution."""
        assert self._ctx is not None, "nothing to show on without a context"
        full = to_camera(view.camera, *size)
        beside = view.compare.mode == "beside"
        camera = half_camera(full) if beside else full
        is_new = self.needs_draw(view, size, pixels)
        timings = self.engine.draw(view, framebuffer, size, pixels, half=1 if beside else None)
        warped = self._photograph_in(camera)
        if pixels > 1:
            self.psnr = math.nan
            self._measured = None
        elif is_new or self._measured != (self.photograph, (camera.width, camera.height)):
            is_plain = self.engine.highlight is None and self.engine.live is None and view.mode == SPLATS
            self._measure(self.engine.renderer.pixels() if is_plain else None, warped)
        if warped.texture is None:
            warped.texture = self._ctx.texture((camera.width, camera.height), 3, warped.image, dtype="f4")
        self._presenter = self._presenter or Presenter(self._ctx)
        edge = camera.width if beside else column(view.compare, size[0])
        framebuffer.scissor = (0, 0, edge, size[1])
        try:
            self._presenter.show(warped.texture, framebuffer)
        finally:
            framebuffer.scissor = None  # type: ignore[assignment]  # its annotation lacks None
        return timings

    def _needs_warp(self, camera: Camera) -> bool:
        """Return whether the last picture of the photograph is not the one of this camera."""
        return self._warped is None or self._warped.key != _warp_key(self.photograph, camera)

    def _photograph_in(self, camera: Camera) -> _Warped:
        """Return the photograph as a camera shows it, computed once."""
        assert self.photograph is not None
        if self._warped is None or self._needs_warp(camera):
            if self._warped is not None and self._warped.texture is not None:
                self._warped.texture.release()
            image, shown = in_view(self.photograph, camera)
            self._warped = _Warped(_warp_key(self.photograph, camera), image.numpy(), shown)
        return self._warped

    def _measure(self, edited: Image | None, warped: _Warped) -> None:
        """Set the PSNR over the pixels that the photograph shows; NaN for no picture or no such pixel."""
        self._measured = (self.photograph, (warped.image.shape[1], warped.image.shape[0]))
        self.psnr = math.nan
        if edited is not None and bool(warped.shown.any()):
            clipped = torch.from_numpy(np.clip(edited, 0.0, 1.0))
            self.psnr = psnr(clipped, torch.from_numpy(warped.image), warped.shown)

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
            timings = self.engine.timings
            if self.photograph is None:
                timings = _add_timings(timings, self._second().timings)
        else:
            timings = FrameTimings(drawn=self.engine.timings.drawn)
        self._presenter = self._presenter or Presenter(self._ctx)
        self._presenter.show(self._texture, framebuffer)
        return timings


def difference(other: Image, edited: Image, amplify: float) -> Image:
    """Return amplify · |edited − other| of the clipped (0..1) pictures; black without a difference.
    [H,W,3]"""
    image: Image = np.abs(np.clip(edited, 0.0, 1.0) - np.clip(other, 0.0, 1.0)) * np.float32(amplify)
    return image


def _psnr(other: Image, edited: Image) -> float:
    """Return the PSNR of two clipped (0..1) pictures, dB."""
    clipped = (torch.from_numpy(np.clip(image, 0.0, 1.0)) for image in (edited, other))
    return psnr(*clipped)


def _add_timings(edited: FrameTimings, original: FrameTimings) -> FrameTimings:
    """Return the sum of both times, with the other figures of the edited picture."""
    return replace(
        edited,
        compose_ms=edited.compose_ms + original.compose_ms,
        upload_ms=edited.upload_ms + original.upload_ms,
        sort_ms=edited.sort_ms + original.sort_ms,
        draw_ms=edited.draw_ms + original.draw_ms,
    )
