"""One engine, on screen and headless: state → compose → upload → sort → draw, published together.

It compares the state with the one it last drew and does only the work between them: a camera move composes
nothing, a change of color sorts nothing, the same state draws nothing.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import moderngl
import numpy as np
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.compose.composer import Composer
from progdf.compose.layers import Gains, Layer
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.scene.bounds import near_plane
from viewer.camera.view_camera import Vec3, bounds_of, half_camera, to_camera
from viewer.state.layers import visible_layers
from viewer.state.paint import layer_of
from viewer.state.view_state import ViewState

from .cpu_renderer import CpuRenderer
from .dynamic_resolution import DrawnView, FrameTimings, drawn_size
from .gl_renderer import GlRenderer, Image, back_to_front, is_software
from .ground_grid import GroundPlane, Lines, grid_lines, ground_plane
from .highlight import Highlight, highlight_colors

DRAWS = ("auto", "gl", "cpu")


@dataclass(frozen=True)
class _Edits:
    """What decides the attributes: the layers that do something, and how they go together."""

    layers: tuple[tuple[int, float, Gains, str], ...] = ()
    blend: str = ""


@dataclass(frozen=True)
class _Picture:
    """What decides the picture."""

    edits: _Edits
    shown: DrawnView
    highlight: Highlight | None


class ViewEngine:
    """Draws one scene under its edits.

    Args:
        ctx: the GL context that pictures are drawn or shown in; None draws on the CPU, for `image` only
        scene: the original
        gdfs: the edits that `LayerState.gdf` counts
        draw: "gl", "cpu", or "auto": "gl" where OpenGL has hardware behind it

    Raises:
        ProgdfError: an edit was made for another scene.
        ValueError: `draw` is unknown, or "gl" without a context.
    """

    def __init__(
        self,
        ctx: moderngl.Context | None,
        scene: Gaussians,
        gdfs: Sequence[Gdf] = (),
        draw: str = "auto",
    ) -> None:
        if draw not in DRAWS:
            raise ValueError(f"draw is '{draw}', expected one of {', '.join(DRAWS)}")
        if draw == "gl" and ctx is None:
            raise ValueError("draw is 'gl', which needs a context")
        self.ctx = ctx
        self.scene = scene
        self.gdfs = tuple(gdfs)
        self.draws_with = draws_with(ctx, draw)
        self.timings = FrameTimings()
        """Of the last picture."""
        self.near = near_plane(bounds_of(scene).radius)
        """Depth at and below which nothing is drawn, world units."""
        self._edits = _Edits()
        self.order: NDArray[np.uint32] = np.zeros(0, np.uint32)
        """Rows from back to front, where the renderer wants them so."""
        self._ordered_for: bytes | None = None
        self._picture: _Picture | None = None
        self.highlight: Highlight | None = None
        """What `draw` shows over the scene; `image` never does, but for what is hidden."""
        self._grid: tuple[object, Lines] | None = None  # what decides the lines, and they
        self._ground: tuple[Vec3, GroundPlane] | None = None  # the plane that is the ground where this is up
        self._highlighted: tuple[Highlight, NDArray[np.uint8]] | None = None  # and its colors. [N,4]
        self.composer = Composer(scene, self.gdfs)
        self.renderer: CpuRenderer | GlRenderer = (
            CpuRenderer(ctx) if ctx is None or self.draws_with == "cpu" else GlRenderer(ctx)
        )
        self.renderer.upload(self.composer.gaussians)

    def needs_draw(self, view: ViewState, size: tuple[int, int], camera: Camera | None = None) -> bool:
        """Whether `view` at `size` (width, height in pixels) is another picture than the last one."""
        shown = DrawnView(camera or to_camera(view.camera, *size), view.background)
        return _Picture(_edits(view), shown, _with_hidden(self.highlight, view)) != self._picture

    def draw(
        self,
        view: ViewState,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int],
        pixels: int = 1,
        half: int | None = None,
    ) -> FrameTimings:
        """Bring the picture up to date and show it in the lower left `size` pixels of `framebuffer`.

        Args:
            pixels: of the framebuffer that one pixel of the picture fills, each way
            half: fill only the left half (0) or the right one (1) of these, see `half_camera`

        Raises:
            ProgdfError: a layer of `view` means nothing; the last picture stays.
        """
        camera = to_camera(view.camera, *drawn_size(size, pixels))
        left = 0
        if half is not None:
            camera = half_camera(camera)
            size = (max(size[0] // 2, 1), size[1])
            left = half * size[0]
        self.timings = self._update_picture(view, camera, self.highlight, pixels)
        self.renderer.show(framebuffer, size, left, self._grid_lines(view, camera))
        return self.timings

    def follow(self, last: ViewEngine) -> bool:
        """Take over another engine's picture, to be shown until there is one of this; whether it could."""
        return last.scene is self.scene and self.renderer.follow(last.renderer)

    def show_last(self, view: ViewState, framebuffer: moderngl.Framebuffer, size: tuple[int, int]) -> None:
        """Show the last picture once more, whatever `view` asks for."""
        self.renderer.show(framebuffer, size, 0, self._grid_lines(view, to_camera(view.camera, *size)))

    def prepare(self, view: ViewState, camera: Camera) -> bool:
        """Begin a picture of `view` without waiting for it; whether `draw` now shows it at once."""
        if not self.needs_draw(view, (camera.width, camera.height), camera):
            return True
        self._compose(_edits(view))
        self._apply_highlight(_with_hidden(self.highlight, view))
        return self.renderer.prepare(replace(camera, near=self.near), view.background)

    def image(
        self,
        view: ViewState,
        size: tuple[int, int] = (0, 0),
        camera: Camera | None = None,
        pixels: int = 1,
    ) -> Image:
        """The picture as an array: upper row first, linear as drawn, 0..1 as far as the colors are.

        Args:
            view: what to draw
            size: width, height in pixels
            camera: takes the place of the view's own camera and of `size`
            pixels: of the picture at rest that one of this one stands for, see `GlRenderer.draw`

        Returns:
            [H,W,3] float32

        Raises:
            ProgdfError: a layer of `view` means nothing.
        """
        self.timings = self._update_picture(view, camera or to_camera(view.camera, *size), pixels=pixels)
        self._picture = self._picture if pixels == 1 else None  # a picture in full is another one
        return self.renderer.pixels()

    def gaussians(self, view: ViewState) -> Gaussians:
        """The scene as `view` shows it. Valid until the engine draws another strength; copy it to keep it."""
        self._compose(_edits(view))
        return self.composer.gaussians

    def release(self) -> None:
        """Give back what lives in the context; the context is the caller's."""
        self.renderer.release()

    def _grid_lines(self, view: ViewState, camera: Camera) -> Lines | None:
        """The grid on the ground in the picture, the same object as long as it is the same."""
        if not view.grid:
            return None
        up = view.camera.up
        if self._ground is None or self._ground[0] != up:
            self._ground = up, ground_plane(self.scene, up)
        seen = up, DrawnView(camera, view.background)
        if self._grid is None or self._grid[0] != seen:
            self._grid = seen, grid_lines(self._ground[1], camera, view.background)
        return self._grid[1]

    def _update_picture(
        self, view: ViewState, camera: Camera, highlight: Highlight | None = None, pixels: int = 1
    ) -> FrameTimings:
        """Do what lies between the last picture and this one."""
        highlight = _with_hidden(highlight, view)
        target = _Picture(_edits(view), DrawnView(camera, view.background), highlight)
        if target == self._picture:
            return FrameTimings(drawn=self.timings.drawn)
        compose_ms, upload_ms, changed = self._compose(target.edits)
        highlight_ms = self._apply_highlight(highlight)
        started = time.perf_counter()
        camera, viewmat = replace(camera, near=self.near), camera.viewmat.numpy().tobytes()
        if self.renderer.wants_order and pixels == 1 and self._ordered_for != viewmat:
            self.order = back_to_front(self.composer.gaussians.means.numpy(), camera)
            self._ordered_for = viewmat
        sorted_at = time.perf_counter()
        self.renderer.draw(camera, view.background, self.order, pixels)
        drawn_at = time.perf_counter()
        self._picture = target
        return FrameTimings(
            compose_ms,
            upload_ms + highlight_ms,
            1e3 * (sorted_at - started),
            1e3 * (drawn_at - sorted_at) + self.renderer.begun_ms,
            changed,
            len(self.order) if self.renderer.wants_order else len(self.scene),
        )

    def _compose(self, edits: _Edits) -> tuple[float, float, int]:
        """Bring attributes up to date; gives ms for composing and uploading, and how many rows changed."""
        if edits == self._edits:
            return 0.0, 0.0, 0
        started = time.perf_counter()
        change = self.composer.update(self._stack(edits), edits.blend or "normalized")
        composed = time.perf_counter()
        self.renderer.update(self.composer.gaussians, change.attributes, change.rows)
        self._edits = edits
        self._picture = None
        if change.means_moved:
            self._ordered_for = None
        return 1e3 * (composed - started), 1e3 * (time.perf_counter() - composed), len(change.rows)

    def _apply_highlight(self, highlight: Highlight | None) -> float:
        """Bring the highlights up to date, those alone that are others than before; gives the ms it took."""
        if highlight == (self._highlighted and self._highlighted[0]):
            return 0.0
        started = time.perf_counter()
        total = len(self.scene)
        nothing = Highlight(), np.zeros((total, 4), np.uint8)
        last = (self._highlighted or nothing)[1]
        new = nothing[1] if highlight is None else highlight_colors(highlight, self.gdfs, total)
        rows = np.flatnonzero(new.view(np.uint32) != last.view(np.uint32))
        self._highlighted = None if highlight is None else (highlight, new)
        if len(rows):
            self.renderer.highlight(rows, new[rows])
        return 1e3 * (time.perf_counter() - started)

    def _stack(self, edits: _Edits) -> list[Layer]:
        """The layers of what was asked for, the lowest first."""
        return [layer_of(self._gdf(layer[0]), *layer[1:]) for layer in edits.layers]

    def _gdf(self, index: int) -> Gdf:
        if not 0 <= index < len(self.gdfs):
            raise ProgdfError(
                f"a layer refers to edit {index + 1} of {len(self.gdfs)}; open its .gdf file too"
            )
        return self.gdfs[index]


def draws_with(ctx: moderngl.Context | None, draw: str) -> str:
    """What "auto" is in a context: "gl" where OpenGL has hardware behind it, else "cpu"."""
    return draw if draw != "auto" else "cpu" if ctx is None or is_software(ctx) else "gl"


def _with_hidden(highlight: Highlight | None, view: ViewState) -> Highlight | None:
    """With what `view` does not draw; None for nothing at all."""
    full = replace(highlight or Highlight(), hidden=view.selection.hidden)
    return None if full == Highlight() else full


def _edits(view: ViewState) -> _Edits:
    """Layers that are not shown or at strength 0 do not count, so that touching them does no work."""
    layers = tuple((l.gdf, l.strength, l.gains, l.paint) for l in visible_layers(view) if l.strength != 0.0)
    return _Edits(layers, view.blend) if layers else _Edits()
