"""Picture in the window: drawn when the view changes, at a lower resolution during interactive rendering."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import moderngl
import numpy as np

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.io.picture_camera import PictureLayers, camera_chunk, save_picture_camera
from viewer.camera.view_camera import to_camera
from viewer.files import exports
from viewer.gl.present import picture_texture
from viewer.panel.panel import Pictures
from viewer.pictures.compare import Comparer, draw_labels
from viewer.pictures.film import Pixels, to_pixels
from viewer.render import dynamic_resolution, highlight
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import Image
from viewer.state.facts import LayerRow
from viewer.state.layers import visible_edits
from viewer.state.selection import EMPTY_MASK
from viewer.state.snapshots import SliderSnapshot, restore, with_original
from viewer.state.transient import PullInfluence
from viewer.state.view_state import Comparison, ViewState
from viewer.state.workspace import Pointed, Workspace
from viewer.ui.context import PALETTE

SETTLE_FRAMES = 3  # imgui needs a frame or two until hovering and layout follow an event
LINGER_S = 0.65
"""Seconds until the tooltip of a still mouse opens: a little more than imgui's own two delays."""


class FramePacer:
    """Counter of frames and idle seconds since the last event."""

    def __init__(self) -> None:
        self._unsettled = SETTLE_FRAMES
        self._rest_left: float | None = LINGER_S  # None: the tooltip has had its frames

    def wake(self) -> None:
        """Restart the counters after an event."""
        self._unsettled = SETTLE_FRAMES
        self._rest_left = LINGER_S

    def rest(self) -> None:
        """Stop requesting frames while the window is minimized."""
        self._unsettled = 0
        self._rest_left = None

    def step(self, seconds: float) -> None:
        """Begin a frame, `seconds` after the last one."""
        if self._unsettled > 0:
            self._unsettled -= 1
        elif self._rest_left is not None:
            self._rest_left -= seconds
            if self._rest_left <= 0.0:
                # imgui advances the delay in this frame, opens the tooltip invisibly in the next one to
                # measure it, and shows it in the one after
                self._unsettled = SETTLE_FRAMES
                self._rest_left = None

    def next_frame_delay(self, others: Sequence[float]) -> float | None:
        """Return the seconds until the next frame is due without an event; None if none is due.

        Args:
            others: seconds until other parts need a frame
        """
        if self._unsettled > 0:
            return 0.0
        waits = [*others] if self._rest_left is None else [*others, self._rest_left]
        return min(waits, default=None)


SIZE = (168, 126)
"""Width and height of a thumbnail, in pixels."""


RememberView = Callable[[Pixels, Camera, Sequence[str], PictureLayers | None], None]
"""Function that remembers a saved picture, its camera, and the names and layers of the visible edits."""


def forget_view(
    _image: Pixels, _camera: Camera, _edits: Sequence[str], _layers: PictureLayers | None
) -> None:
    """Remember nothing: the scene has no file."""


LayersOf = Callable[[ViewState], PictureLayers | None]
"""Function that returns the visible layers of a view, see `exports.picture_layers`."""


def no_layers(_view: ViewState) -> PictureLayers | None:
    """Return no layers: the edits have no files."""
    return None


class Thumbnails:
    """Thumbnails as GL textures. `ctx`: the GL context of the textures"""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._made: dict[object, moderngl.Texture] = {}

    def update(self, draws: Mapping[object, Callable[[], Pixels]]) -> tuple[tuple[int, ...], bool]:
        """Draw at most one missing thumbnail, so that a session with many stays responsive.

        Args:
            draws: functions that draw a thumbnail, by a key of everything that it depends on

        Returns:
            Texture names, 0 for one that is not drawn yet; True if any is still missing.
        """
        for key in [key for key in self._made if key not in draws]:
            self._made.pop(key).release()
        missing = [key for key in draws if key not in self._made]
        for key in missing[:1]:
            self._made[key] = picture_texture(self._ctx, draws[key]())
        return tuple(self._made[key].glo if key in self._made else 0 for key in draws), len(missing) > 1

    def release(self) -> None:
        for texture in self._made.values():
            texture.release()
        self._made.clear()


class Canvas:
    """Rendered splats on screen, and the thumbnails of snapshots and edits.

    Args:
        context: the GL context of the engine
        engine: draws the splats; owned by the caller
        last: the canvas of the same scene with other edits; its picture stays until the first new one
    """

    def __init__(self, context: moderngl.Context, engine: ViewEngine, last: Canvas | None = None) -> None:
        self.comparer = Comparer(engine, context)
        self._thumbnails = Thumbnails(context)
        self._photographs = Thumbnails(context)
        self.timings = dynamic_resolution.FrameTimings()
        """Timings of the picture on screen."""
        self.pictures_drawn = 0
        """Number of pictures drawn."""
        self._resolution = dynamic_resolution.first_known(len(engine.scene), engine.draws_with)
        self._last: tuple[object, object] = ((), ())  # last drawn: camera and size, edits
        self.compares_grade = False  # the original is shown to compare it with the form's grade
        self._sliding = False  # the current drag changes the edits
        self._awaited: object = None  # key of the picture being drawn while the last one stays on screen
        self._begun: tuple[ViewState, tuple[int, int]] | None = None  # view and size of an unfinished picture
        self._follows = last is not None and engine.follow(last.comparer.engine)
        if last is not None and self._follows:
            self._resolution = last._resolution
            self._last = last._last

    def draw(
        self,
        view: ViewState,
        screen: moderngl.Framebuffer,
        size: tuple[int, int],
        dragging: bool,
        now: float,
        focus: int | None = None,
        pointed: Pointed | None = None,
        live: bool = False,
        *,
        pulled: PullInfluence | None = None,
        guessed: bytes = EMPTY_MASK,
    ) -> None:
        """Draw `view` into the lower left `size` pixels of `screen`.

        Args:
            focus: the layer whose painted weights are visible while the brush is active, or None
            pointed: the item of the panel under the pointer
            pulled: Gaussians that a handle moves right now, or None
            guessed: selected Gaussians that no view with a scribble shows, packed
            live: an edit in training or preview is on top
            dragging: the mouse drags something, so that more frames will follow
            now: seconds on the main view's clock

        Raises:
            ProgdfError: a layer of `view` is invalid.
        """
        screen.use()
        screen.clear(*PALETTE.panel)
        aim = (view.camera, size)
        engine = self.comparer.engine
        edits = (view.layers, view.blend, view.background, view.mode, engine.version, engine.live)
        turned = aim != self._last[0]
        slid = edits != self._last[1]
        self._last = (aim, edits)
        self._sliding = dragging and (self._sliding or slid)
        mode = "off" if view.compare.mode == "difference" else view.dynamic_resolution
        before = self._resolution
        self._resolution = dynamic_resolution.before_draw(before, mode, dragging, turned, slid, now)
        looks = self._sliding or live
        graded = self.compares_grade or engine.live is not None
        self.comparer.engine.highlight = highlight.requested_highlight(
            view, focus, pointed, looks, pulled, guessed, graded
        )
        target = aim, edits, self.comparer.engine.highlight
        has_picture = self.pictures_drawn or self._follows
        self._begun = None
        if mode != "off" and has_picture and dynamic_resolution.takes_long(before, self._resolution):
            moves = turned or (dragging and self._awaited not in (None, target))
            if moves or not self.comparer.prepare(view, size):
                stays = not moves and before.pixels == 1 and view.compare.mode == "off"
                self._resolution = dynamic_resolution.wait(self._resolution, now, coarsely=not stays)
                self._awaited = target
                self._begun = None if moves else (view, size)
                if stays:
                    self.comparer.engine.show_last(view, screen, size)
                    return
        new = self.comparer.needs_draw(view, size, self.pixels)
        timings = self.comparer.draw(view, screen, size, self.pixels)
        if self.pixels == 1:
            self._awaited = None
        if new:
            self.timings = timings
            self.pictures_drawn += 1
            self._resolution = dynamic_resolution.after_draw(self._resolution, timings, turned)

    @property
    def pixels(self) -> int:
        """Window pixels per picture pixel, each way; more than 1 during interactive rendering."""
        return self._resolution.pixels

    def next_frame_delay(self, now: float) -> float | None:
        """Return the seconds until the picture must be drawn at full resolution; None if it already is."""
        return dynamic_resolution.next_frame_delay(self._resolution, now)

    def awaits_picture(self) -> bool:
        """Return True if a picture is being drawn and there is no new part to show yet."""
        if self._begun is None or self.comparer.prepare(*self._begun):
            return False
        return not self.comparer.engine.renderer.has_parts

    def image(self, view: ViewState, size: tuple[int, int]) -> Image:
        """Return the picture at full resolution; see `Comparer.image`. [H,W,3]"""
        return self.comparer.image(view, size)

    def save(
        self,
        folder: Path,
        title: str,
        view: ViewState,
        size: tuple[int, int],
        layers: PictureLayers | None,
        remember: RememberView,
    ) -> str:
        """Write the picture of a view with its camera; return a line with the path.

        Args:
            folder: target folder; the file's name begins with `title`
            layers: the visible edits, see `camera_chunk`
            remember: receives the picture, unless it is a comparison

        Raises:
            ProgdfError: see `exports.picture`.
        """
        if view.mode != ViewState.mode and view.compare.mode == "off":  # no picture of the scene's colors
            image = self.comparer.engine.image(view, size, mode=view.mode)
            return f"Saved {exports.picture(folder, f'{title}-{view.mode}', to_pixels(image))}"
        image = self.image(view, size)
        pixels = draw_labels(image, view.compare, self.comparer.labels(view))
        if view.compare.mode != "off":  # a comparison cannot be edited and trained on
            return f"Saved {exports.picture(folder, title, pixels)}"
        camera = to_camera(view.camera, image.shape[1], image.shape[0])
        origin = self.comparer.engine.scene.origin
        edits = visible_edits(view)
        chunk = camera_chunk(camera, edits, origin, view.camera.up, layers)
        path = exports.picture(folder, title, pixels, chunk)
        remember(pixels, camera, edits, layers)
        return f"Saved {path}"

    def whole(self, view: ViewState, size: tuple[int, int]) -> Pixels:
        """Return the picture of the whole scene with the visible edits, not compared. [H,W,3]"""
        selection = replace(view.selection, hidden=EMPTY_MASK)
        return to_pixels(self.image(replace(view, selection=selection, compare=Comparison()), size))

    def save_whole(
        self,
        folder: Path,
        title: str,
        view: ViewState,
        size: tuple[int, int],
        layers: PictureLayers | None,
        remember: RememberView,
    ) -> Path:
        """Write the picture of the whole scene, and its camera and layers beside it, to be edited in another
        program; return the picture's path. See `save`.

        Raises:
            ProgdfError: see `exports.picture`.
        """
        camera = to_camera(view.camera, *size)
        origin = self.comparer.engine.scene.origin
        edits = visible_edits(view)
        chunk = camera_chunk(camera, edits, origin, view.camera.up, layers)
        pixels = self.whole(view, size)
        path = exports.picture(folder, title, pixels, chunk)
        # a program may drop the picture's metadata
        save_picture_camera(path, camera, origin, layers)
        remember(pixels, camera, edits, layers)
        return path

    def thumbnails(self, work: Workspace, rows: Sequence[LayerRow]) -> tuple[Pictures, bool]:
        """Return the thumbnails of the snapshots, the original first, and of the edits; True if any is
        missing."""
        snapshots = with_original(work.snapshots, work.view) if work.snapshots else ()
        draws: dict[object, Callable[[], Pixels]] = {
            # the original has no edit, whichever of its layers are active
            (i, snapshot.edit if i else None, snapshot.camera): partial(
                self._draw_snapshot, i, snapshot, work.view
            )
            for i, snapshot in enumerate(snapshots)
        }
        draws |= {(i, id(row.thumbnail)): partial(row.thumbnail, work.home) for i, row in enumerate(rows)}
        names, missing = self._thumbnails.update(draws)
        return Pictures(names[: len(snapshots)], names[len(snapshots) :]), missing

    def photographs(self, draws: Mapping[object, Callable[[], Pixels]]) -> tuple[dict[object, int], bool]:
        """Return the GL names of photographs that are loaded, by key; True if any is missing."""
        names, missing = self._photographs.update(draws)
        return {key: name for key, name in zip(draws, names, strict=True) if name}, missing

    def _draw_snapshot(self, index: int, snapshot: SliderSnapshot, view: ViewState) -> Pixels:
        edited = replace(view, layers=()) if index == 0 else restore(view, snapshot)
        target = replace(edited, camera=snapshot.camera, compare=Comparison())
        engine = self.comparer.engine
        try:
            many = len(engine.scene) >= dynamic_resolution.SLOW_SCENE_GAUSSIANS
            return to_pixels(engine.image(target, SIZE, pixels=2 if many else 1))
        except ProgdfError:  # the edit is not open
            return np.zeros((SIZE[1], SIZE[0], 3), np.uint8)

    def release(self) -> None:
        """Free everything but the engine."""
        self.comparer.release()
        self._thumbnails.release()
        self._photographs.release()
