"""Render engine for the window and headless use: compose, upload, sort, draw.

The engine compares the state with the last drawn one and does only the necessary work. A camera move composes
nothing, a change of color sorts nothing, and the same state draws nothing.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import moderngl
import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.compose.composer import Composer
from progdf.compose.layer_paint import layer_of
from progdf.compose.layers import DEFAULT_BLEND, Gains, Layer
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.motions import PartMotions
from progdf.rasterize.first_start import compile_with_bar
from progdf.rasterize.screen import draw_lines_behind
from progdf.scene.bounds import near_plane
from viewer.camera.view_camera import Vec3, bounds_of, first_camera, half_camera, to_camera
from viewer.state.layers import visible_layers
from viewer.state.view_state import ViewState

from .cpu_renderer import CpuRenderer
from .dynamic_resolution import DrawnView, FrameTimings, MovingGrade, drawn_size
from .gl_renderer import GlRenderer, Image, back_to_front, headless_context, is_software
from .ground_grid import GroundPlane, Lines, grid_lines, ground_plane
from .highlight import Highlight, highlight_colors
from .live_grade import LiveColors, LiveGrade
from .view_modes import SPLATS

DRAWS = ("auto", "gl", "cpu")


@dataclass(frozen=True)
class _Edits:
    """Inputs of the composed attributes: the effective layers and the blend rule."""

    layers: tuple[tuple[int, float, Gains, str, str], ...] = ()
    blend: str = ""
    version: int = -1  # see `ViewEngine.touch`; −1 for the current state


@dataclass(frozen=True)
class _Picture:
    """Inputs of the picture."""

    edits: _Edits
    shown: DrawnView
    highlight: Highlight | None
    live: LiveGrade | None


class ViewEngine:
    """Engine that draws one scene with its edits.

    Args:
        ctx: GL context to draw or show pictures in; None draws on the CPU, for `image` only
        scene: the original
        gdfs: the edits, indexed by `LayerState.gdf`
        draw: "gl", "cpu", or "auto" ("gl" if OpenGL is hardware-accelerated)

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
        """Times of the last picture."""
        self.near = near_plane(bounds_of(scene).radius)
        """Near plane, world units: nothing is drawn at or below this depth."""
        self.version = 0
        """Number of changes of the offsets of edits in progress, see `touch`."""
        self._edits = _Edits()
        self.order: NDArray[np.uint32] = np.zeros(0, np.uint32)
        """Rows from back to front, if the renderer needs them."""
        self._ordered_for: bytes | None = None
        self._picture: _Picture | None = None
        self.highlight: Highlight | None = None
        """Highlight that `draw` shows over the scene. `image` applies only hidden Gaussians."""
        self.live: LiveGrade | None = None
        """Grade that `draw` shows over all layers. `image` and `gaussians` ignore it."""
        self._graded: tuple[tuple[object, object, tuple[float, ...]], LiveGrade] | None = (
            None  # inputs of the live colors on screen
        )
        self._live_colors = LiveColors()
        self._grid: tuple[object, Lines] | None = None  # inputs of the grid lines, and the lines
        self._ground: tuple[Vec3, GroundPlane] | None = None  # up axis and its ground plane
        self._highlighted: tuple[Highlight, NDArray[np.uint8]] | None = None  # with its colors. [N,4]
        self.composer = Composer(scene, self.gdfs)
        self.renderer: CpuRenderer | GlRenderer = (
            CpuRenderer(ctx) if ctx is None or self.draws_with == "cpu" else GlRenderer(ctx)
        )
        self.renderer.upload(self.composer.gaussians)

    def needs_draw(self, view: ViewState, size: tuple[int, int], camera: Camera | None = None) -> bool:
        """Return whether `view` at `size` (width, height, px) differs from the last picture."""
        shown = DrawnView(camera or to_camera(view.camera, *size), view.background, mode=view.mode)
        return _Picture(_edits(view), shown, _with_hidden(self.highlight, view), self.live) != self._picture

    def draw(
        self,
        view: ViewState,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int],
        pixels: int = 1,
        half: int | None = None,
    ) -> FrameTimings:
        """Update the picture and show it in the lower left `size` pixels of `framebuffer`.

        Args:
            view: state to draw
            framebuffer: target
            size: width and height, px
            pixels: framebuffer pixels per pixel of the picture, along each axis
            half: fill only the left (0) or right (1) half, see `half_camera`

        Raises:
            ProgdfError: a layer of `view` is invalid; the last picture is kept.
        """
        camera = to_camera(view.camera, *drawn_size(size, pixels))
        left = 0
        if half is not None:
            camera = half_camera(camera)
            size = (max(size[0] // 2, 1), size[1])
            left = half * size[0]
        self.timings = self._update_picture(view, camera, self.highlight, pixels, view.mode, self.live)
        self.renderer.show(framebuffer, size, left, self._grid_lines(view, camera))
        return self.timings

    def follow(self, last: ViewEngine) -> bool:
        """Take over the picture of another engine until this one has drawn.

        Return whether that was possible.
        """
        return last.scene is self.scene and self.renderer.follow(last.renderer)

    def show_last(self, view: ViewState, framebuffer: moderngl.Framebuffer, size: tuple[int, int]) -> None:
        """Show the last picture again, with the grid of `view`."""
        self.renderer.show(framebuffer, size, 0, self._grid_lines(view, to_camera(view.camera, *size)))

    def prepare(self, view: ViewState, camera: Camera) -> bool:
        """Begin a picture of `view` in the background. Return whether `draw` can show it at once."""
        if not self.needs_draw(view, (camera.width, camera.height), camera):
            return True
        self._compose(_edits(view))
        self._apply_live(self.live, camera)
        self._apply_highlight(_with_hidden(self.highlight, view))
        return self.renderer.prepare(replace(camera, near=self.near), view.background, view.mode)

    def image(
        self,
        view: ViewState,
        size: tuple[int, int] = (0, 0),
        camera: Camera | None = None,
        pixels: int = 1,
        mode: str = SPLATS,
    ) -> Image:
        """Render the picture as an array: upper row first, not clamped.

        Args:
            view: state to draw
            size: width and height, px
            camera: replaces the view's camera and `size`
            pixels: full-resolution pixels per pixel, see `GlRenderer.draw`
            mode: one of `view_state.VIEW_MODES`; that of the view applies to the window alone

        Returns:
            [H,W,3] float32

        Raises:
            ProgdfError: a layer of `view` is invalid.
        """
        camera = camera or to_camera(view.camera, *size)
        self.timings = self._update_picture(view, camera, pixels=pixels, mode=mode)
        self._picture = self._picture if pixels == 1 else None  # a full picture will differ
        return self.renderer.pixels()

    def gaussians(self, view: ViewState) -> Gaussians:
        """Return the edited scene. Valid until the engine draws other strengths; copy it to keep it."""
        self._compose(_edits(view))
        return self.composer.gaussians

    def adopt(self, composer: Composer, gdfs: Sequence[Gdf]) -> None:
        """Compose with another composer of the same rows, without drawing or uploading the whole scene again.

        The last edit in `gdfs` may be an edit in progress, as may the last one before.

        Args:
            composer: composer of the scene with `gdfs`
            gdfs: the edits, indexed by `LayerState.gdf`; those that both composers have keep their index
        """
        common = min(len(gdfs), len(self.gdfs))
        same = [i for i in range(common) if gdfs[i] is self.gdfs[i]]
        kept = tuple(layer for layer in self._edits.layers if layer[0] in same)
        edits = _Edits(kept, self._edits.blend) if kept else _Edits()
        self._compose(edits)
        self.gdfs = tuple(gdfs)
        self.composer = composer
        composer.update(self._stack(edits), edits.blend or DEFAULT_BLEND)
        self._picture = None
        self.version += 1

    def touch(self, gdf: Gdf, motions: PartMotions | None = None) -> None:
        """Draw an edit in progress again, whose offsets were written in place, see `Composer.touch`."""
        self.composer.touch(gdf, motions)
        self._edits = replace(self._edits, version=self.version)
        self._picture = None
        self.version += 1

    def release(self) -> None:
        """Release the GL objects. The context belongs to the caller."""
        self.renderer.release()

    def _grid_lines(self, view: ViewState, camera: Camera) -> Lines | None:
        """Return the lines of the ground grid, the same object while they are unchanged."""
        if not view.grid:
            return None
        up = view.camera.up
        if self._ground is None or self._ground[0] != up:
            self._ground = up, ground_plane(self.scene, up)
        grid_inputs = up, DrawnView(camera, view.background)
        if self._grid is None or self._grid[0] != grid_inputs:
            self._grid = grid_inputs, grid_lines(self._ground[1], camera, view.background)
        return self._grid[1]

    def _update_picture(
        self,
        view: ViewState,
        camera: Camera,
        highlight: Highlight | None = None,
        pixels: int = 1,
        mode: str = SPLATS,
        live: LiveGrade | None = None,
    ) -> FrameTimings:
        """Do the work between the last picture and this one."""
        highlight = _with_hidden(highlight, view)
        target = _Picture(_edits(view), DrawnView(camera, view.background, mode=mode), highlight, live)
        if target == self._picture:
            return FrameTimings(drawn=self.timings.drawn)
        compose_ms, upload_ms, changed = self._compose(target.edits)
        grade_ms = self._apply_live(live, camera, is_coarse=pixels > 1 and mode == SPLATS)
        highlight_ms = self._apply_highlight(highlight)
        started = time.perf_counter()
        viewmat = camera.viewmat.numpy().tobytes()
        camera = replace(camera, near=self.near)
        if self.renderer.wants_order and pixels == 1 and self._ordered_for != viewmat:
            self.order = back_to_front(self.composer.gaussians.means.numpy(), camera)
            self._ordered_for = viewmat
        sorted_at = time.perf_counter()
        self.renderer.draw(camera, view.background, self.order, pixels, mode)
        drawn_at = time.perf_counter()
        self._picture = target
        return FrameTimings(
            compose_ms + grade_ms,
            upload_ms + highlight_ms,
            1e3 * (sorted_at - started),
            1e3 * (drawn_at - sorted_at) + self.renderer.begun_ms,
            changed,
            len(self.order) if self.renderer.wants_order else len(self.scene),
        )

    def _compose(self, edits: _Edits) -> tuple[float, float, int]:
        """Update the attributes. Return the ms of composing and uploading, and the number of changed rows."""
        if edits == self._edits:
            return 0.0, 0.0, 0
        started = time.perf_counter()
        change = self.composer.update(self._stack(edits), edits.blend or DEFAULT_BLEND)
        composed = time.perf_counter()
        self.renderer.update(self.composer.gaussians, change.attributes, change.rows)
        self._edits = edits
        self._picture = None
        if change.means_moved:
            self._ordered_for = None
        return 1e3 * (composed - started), 1e3 * (time.perf_counter() - composed), len(change.rows)

    def _apply_live(self, live: LiveGrade | None, camera: Camera, is_coarse: bool = False) -> float:
        """Update the colors under the live grade and return the time taken, ms.

        Pictures during motion are graded by themselves, see `MovingGrade`. Before they can be, they have the
        colors of full pictures, from the last position.
        """
        version = (self._edits, self.composer)
        moving = None
        if live is not None:
            detail = self._live_colors.detail(self.composer.gaussians, live, version)
            moving = MovingGrade(live.rows, partial(self._live_colors.recolor, live), detail)
        if self.renderer.grade_motion(moving) and is_coarse:
            return 0.0
        if live is None and self._graded is None:
            return 0.0
        started = time.perf_counter()
        position = tuple(camera.position.tolist()) if self.scene.sh_degree else ()
        if is_coarse and self._graded is not None:
            position = self._graded[0][2]
        inputs = (self._edits, self.composer, position)
        last = self._graded
        if last is not None and (live is None or last[1].rows is not live.rows):
            self.renderer.show_grade(None, last[1].rows)
            self._graded = None
        elif last is not None and last[0] == inputs and last[1] == live:
            return 0.0
        if live is not None:
            graded = self._live_colors.apply(self.composer.gaussians, live, camera, version)
            self.renderer.show_grade(graded, live.rows)
            self._graded = inputs, live
        self._picture = None
        return 1e3 * (time.perf_counter() - started)

    def _apply_highlight(self, highlight: Highlight | None) -> float:
        """Update the changed highlights and return the time taken, ms."""
        if highlight == (self._highlighted and self._highlighted[0]):
            return 0.0
        started = time.perf_counter()
        total = len(self.scene)
        empty = Highlight(), np.zeros((total, 4), np.uint8)
        last = (self._highlighted or empty)[1]
        new = empty[1] if highlight is None else highlight_colors(highlight, self.gdfs, total)
        rows = np.flatnonzero(new.view(np.uint32) != last.view(np.uint32))
        self._highlighted = None if highlight is None else (highlight, new)
        if len(rows):
            self.renderer.highlight(rows, new[rows])
        return 1e3 * (time.perf_counter() - started)

    def _stack(self, edits: _Edits) -> list[Layer]:
        """Return the composer's layers of `edits`, lowest first."""
        return [layer_of(self._gdf(layer[0]), *layer[1:]) for layer in edits.layers]

    def _gdf(self, index: int) -> Gdf:
        if not 0 <= index < len(self.gdfs):
            raise ProgdfError(
                f"a layer refers to edit {index + 1} of {len(self.gdfs)}; open its .gdf file too"
            )
        return self.gdfs[index]


def draws_with(ctx: moderngl.Context | None, draw: str) -> str:
    """Resolve "auto" in a context: "gl" if OpenGL is hardware-accelerated, else "cpu"."""
    if draw != "auto":
        return draw
    return "cpu" if ctx is None or is_software(ctx) else "gl"


def _with_hidden(highlight: Highlight | None, view: ViewState) -> Highlight | None:
    """Add the hidden Gaussians of `view` to the highlight. Return None if it is empty."""
    full = replace(highlight or Highlight(), hidden=view.selection.hidden)
    return None if full == Highlight() else full


def _edits(view: ViewState) -> _Edits:
    """Return the effective layers. Changes of invisible layers and layers at strength 0 cause no work."""
    active = [layer for layer in visible_layers(view) if layer.strength != 0.0]
    layers = tuple((l.gdf, l.strength, l.gains, l.paint, l.blend) for l in active)
    return _Edits(layers, view.blend) if layers else _Edits()


@contextmanager
def headless_engine(scene: Gaussians, gdfs: Sequence[Gdf], draws: str) -> Iterator[ViewEngine]:
    """Create an engine for pictures without a window; "auto" works without OpenGL if there is none.

    Args:
        scene: the original
        gdfs: its edits
        draws: one of `DRAWS`

    Raises:
        ProgdfError: "gl", and there is no OpenGL.
    """
    ctx = None
    if draws != "cpu":
        try:
            ctx = headless_context()
        except ProgdfError:
            if draws == "gl":
                raise
    engine = ViewEngine(ctx, scene, gdfs, draws)
    try:
        if engine.draws_with == "cpu":
            compile_with_bar("draw")
        yield engine
    finally:
        engine.release()
        if ctx is not None:
            ctx.release()


def draw_once() -> None:
    """Draw a small picture, which loads the kernels, or compiles them the first time on a machine."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    quats = torch.eye(4)[:1].expand(8, 4)
    none = corners[:, None, :][:, :0]
    scene = Gaussians(corners, quats, corners - 2.0, corners[:, 0], corners, none)
    ViewEngine(None, scene).image(ViewState(camera=first_camera(scene)), (32, 24))
    image = np.zeros((2, 2, 3), np.float32)
    with draw_lines_behind(image, np.ones((2, 2), np.float32), np.zeros((1, 14), np.float32), 0.5):
        pass
