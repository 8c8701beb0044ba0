"""One window's content: input → workspace → picture → screen. Knows imgui and GL, but no windowing system.

The window (app.py) and the tests feed imgui's io and call `frame`: a scripted mouse goes a real one's way.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray

from progdf.errors import ProgdfError

from . import (
    brush,
    compare_overlay,
    controls,
    dialogs,
    draft,
    inputs,
    overlay,
    paint,
    panel,
    playback,
    stack,
    timeline_bar,
    timeline_file,
    workspace,
)
from .compare import Comparer, labelled
from .engine import Engine, FrameTimings, drawn_size
from .gl.screen import read_rgb
from .inputs import NO_KEYS, Keys
from .pace import Pace
from .paint import Stroke
from .pick import layer_at, seen_at, surface_point
from .pictures import free_path, save_picture
from .snapshot_cards import SnapshotCard
from .snapshots import Snapshot, shown
from .state import ViewCamera, ViewState
from .thumbnails import Thumbnails
from .turntable import to_camera
from .ui_context import PALETTE, UiContext
from .workspace import Dialog, Message, SceneFacts

FLIGHT_S, BLINK_S = 1 / 60, 0.3  # between frames: while flying; while a text field is open
MESSAGE_S, ERROR_S = 6.0, 15.0
CLICK_PX = 3.0  # a press that moves no further, at 1×, is a click


class Stage:
    """Draws frames of one engine into the framebuffer it is given.

    Args:
        context: the GL context of the engine
        engine: draws the picture
        facts: of the open scene
        view: what to show first
        scale: window pixels per design pixel (see UiContext)
        pictures: folder into which saved pictures go
    """

    def __init__(
        self,
        context: moderngl.Context,
        engine: Engine,
        facts: SceneFacts,
        view: ViewState,
        scale: float = 1.0,
        pictures: Path = Path(),
    ) -> None:
        self.context, self.engine, self.facts, self.pictures = context, engine, facts, pictures
        self.comparer, self.thumbnails = Comparer(engine, context), Thumbnails(context, engine)
        self.recent: tuple[Path, ...] = ()  # files opened before, for the dialogs
        self.ui = UiContext(scale)
        imgui.backends.opengl3_init("#version 330")
        self.work = workspace.opened(view)
        self.frames = 0  # all that were drawn
        self.drawn = 0  # those with a new picture of the splats
        self.timings = FrameTimings()  # of the picture on screen
        self.latencies_ms: deque[float] = deque(maxlen=120)  # from a slider's event to finished pixels
        self._drag: str | None = None
        self._stroke: Stroke | None = None  # of the brush, while `_drag` is brush.DRAG
        self._revealed = self.work.focus  # the layer that the panel was last scrolled to
        self._keys = NO_KEYS  # of the present frame
        self._clock = 0.0
        self._draft = draft.Draft()
        self._last_shown: tuple[object, object] = ((), ())  # camera and size, edits
        self._pace = Pace()
        self.wake, self.rest = self._pace.wake, self._pace.rest

    def close(self) -> None:
        """Free what the stage made; the engine and the context are the caller's."""
        self.ui.make_current()
        imgui.backends.opengl3_shutdown()
        self.ui.close()
        self.comparer.release()
        self.thumbnails.release()

    def serve(self, engine: Engine, facts: SceneFacts) -> None:
        """Draw with another engine from now on (the scene or its edits have changed)."""
        self.comparer.release()
        self.thumbnails.release()
        self.engine, self.facts, self.comparer = engine, facts, Comparer(engine, self.context)
        self.thumbnails = Thumbnails(self.context, engine)
        self.wake()

    def change(self, view: ViewState) -> None:
        """A new state from outside the window; what it edits can be undone."""
        self.work = workspace.settled(replace(self.work, view=view))
        self.wake()

    def restart(self, view: ViewState, kept: tuple[Snapshot, ...] = ()) -> None:
        """A new state and snapshots, with nothing to undo."""
        self.work = workspace.opened(view, kept)
        self.wake()

    def patience(self) -> float | None:
        """Seconds the window may wait for an event before the next `frame`; None: for ever."""
        self.ui.make_current()
        waits = [FLIGHT_S] if inputs.flying(self._keys) else []
        if imgui.get_io().want_text_input:
            waits.append(BLINK_S)
        if self.work.message is not None:
            waits.append(max(self.work.message.until - self._clock, 0.0))
        sharpens = draft.patience(self._draft, self._clock)
        waits += [] if sharpens is None else [sharpens]
        film = playback.patience(self.work.player, self.work.view.timeline)
        return self._pace.patience(waits if film is None else [*waits, film])

    def tell(self, text: str, error: bool = False) -> None:
        """Show one line at the bottom of the picture for a while."""
        until = self._clock + (ERROR_S if error else MESSAGE_S)
        self.work = replace(self.work, message=Message(" ".join(text.split()), until, error))
        self.wake()

    def greet(self, screen: moderngl.Framebuffer) -> None:
        """A word while the first picture is made: that may take seconds, and the window is already there."""
        self.ui.make_current()
        imgui.backends.opengl3_new_frame()
        imgui.new_frame()
        overlay.banner(f"Opening {self.facts.title} …", self._area(), self.ui)
        imgui.render()
        screen.use()
        screen.clear(*self.work.view.background)
        imgui.backends.opengl3_render_draw_data(imgui.get_draw_data())

    def frame(
        self,
        screen: moderngl.Framebuffer,
        size: tuple[int, int],
        seconds: float,
        keys: Keys = NO_KEYS,
        arrived: float | None = None,
    ) -> None:
        """Handle the input that imgui's io holds, and draw.

        Args:
            screen: where to draw
            size: its width and height in pixels: io.display_size times io.display_framebuffer_scale
            seconds: since the last frame
            keys: what the keyboard did
            arrived: time.perf_counter() when the input came; now if None
        """
        arrived = time.perf_counter() if arrived is None else arrived
        self.ui.make_current()
        imgui.get_io().delta_time = max(seconds, 1e-5)
        self._clock += max(seconds, 0.0)
        self._pace.step()
        self.work = workspace.played(self.work, seconds)
        before = self.work
        imgui.backends.opengl3_new_frame()
        imgui.new_frame()
        self._keys = keys
        self._handle_input(seconds)
        if not imgui.is_any_item_active() and self._drag is None and not inputs.repeating(keys):
            self.work = workspace.settled(self.work)
        if self.work != before:
            self.wake()
        self._draw_picture(screen)
        self._draw_overlays()
        imgui.render()
        screen.use()
        imgui.backends.opengl3_render_draw_data(imgui.get_draw_data())
        self.frames += 1
        if _strengths(self.work.view) != _strengths(before.view):
            self.context.finish()
            self.latencies_ms.append(1e3 * (time.perf_counter() - arrived))
        self._save_pictures(screen, size)

    def _area(self) -> overlay.Area:
        """The part of the window that shows the picture."""
        display = imgui.get_io().display_size
        wide = panel.width(self.ui) if self.work.view.panel else 0.0
        return overlay.Area(max(display.x - wide, 1.0), max(display.y, 1.0))

    def _picture_size(self) -> tuple[int, int]:
        """The picture's size in framebuffer pixels."""
        area, density = self._area(), imgui.get_io().display_framebuffer_scale
        return max(round(area.width * density.x), 1), max(round(area.height * density.y), 1)

    def _handle_input(self, seconds: float) -> None:
        for action in inputs.actions_pressed(self._keys):
            if self.work.dialog is None or action in ("picture", "window_picture"):
                self._perform(action)
        if inputs.flying(self._keys):
            flown = inputs.fly(self.work.view.camera, self._keys, seconds, self.facts.bounds.radius)
            self.work = workspace.with_camera(self.work, flown)
        if self.work.view.panel:
            self._panel(reveal=self.work.focus != self._revealed)
            self._timeline()
        camera = self._moved_by_mouse(self.work.view.camera)  # may move the divider of a split instead
        self.work = workspace.with_camera(self.work, camera)

    def _perform(self, action: str) -> None:
        area = self._area()
        self.work = workspace.perform(self.work, action, self.facts, area.width / area.height)

    def _panel(self, reveal: bool) -> None:
        facts, past = self.facts, self.work.past
        shown = panel.PanelInput(
            facts.title,
            facts.count,
            facts.rows,
            self.work.focus,
            len(past.past),
            len(past.future),
            reveal,
            self.work.dial,
            self.work.renaming,
            self._cards(),
        )
        result = panel.draw(self.work.view, shown, self.ui)
        self.work = replace(self.work, view=result.state, focus=result.focus, renaming=result.renaming)
        self._revealed = result.focus
        for action in result.actions:
            self._perform(action)

    def _timeline(self) -> None:
        player = self.work.player
        if player.shown:
            for action in timeline_bar.draw(self.work.view.timeline, player, self._area(), self.ui):
                self._perform(action)

    def _moved_by_mouse(self, camera: ViewCamera) -> ViewCamera:
        io, radius, scale = imgui.get_io(), self.facts.bounds.radius, self.ui.scale
        dx, dy = io.mouse_delta.x / scale, io.mouse_delta.y / scale
        if self._drag == compare_overlay.DIVIDER:
            self.work = replace(self.work, view=compare_overlay.moved(self.work.view, self._area()))
        elif self._drag == brush.DRAG:
            self._paint()
        elif self._drag and (dx or dy):
            # also where the button went up within this frame: a slow frame must not lose the end of a drag
            camera = controls.drag(camera, self._drag, dx, dy, self._area().height / scale, radius)
        if imgui.is_mouse_released(0) and self._drag in ("orbit", "look") and not self._dragged():
            self._focus_picked(camera)
        if not inputs.any_button_down():
            self._drag = None
        if not io.want_capture_mouse:
            if self._grips_divider():
                compare_overlay.show_grip()
                if imgui.is_mouse_clicked(0):
                    self._drag = compare_overlay.DIVIDER
                    return camera
            if self.work.view.brush.active and imgui.is_mouse_clicked(0):
                self._begin_stroke()
                return camera
            if imgui.is_mouse_double_clicked(0):
                return self._pivot_picked(camera)
            self._drag = inputs.drag_begun(camera.mode) or self._drag
            camera = controls.zoom(camera, io.mouse_wheel, radius) if io.mouse_wheel else camera
        return camera

    def _grips_divider(self) -> bool:
        """Whether the divider of a split is in the hand, or under it."""
        if self._drag is not None:
            return self._drag == compare_overlay.DIVIDER
        over = imgui.get_io().want_capture_mouse
        return not over and compare_overlay.near(self.work.view, self._area(), self.ui)

    def _begin_stroke(self) -> None:
        """The brush comes down on the focused layer, or says why it cannot."""
        work = self.work
        reason = brush.obstacle(work.view, work.focus)
        if reason or work.focus is None:
            self.tell(f"Nothing to paint: {reason}", error=True)
            return
        self._drag = brush.DRAG
        layer, camera = work.view.layers[work.focus], to_camera(work.view.camera, *self._picture_size())
        scene, through = self.engine.gaussians(work.view), work.view.brush.through
        self._stroke = paint.begun(layer.paint, self.engine.gdfs[layer.gdf], scene, camera, through)
        self._paint()

    def _paint(self) -> None:
        """The brush moves to the cursor; what it has painted so far is shown at once."""
        density = imgui.get_io().display_framebuffer_scale.x * self.ui.scale
        view, focus = self.work.view, self.work.focus
        if self._stroke is not None and focus is not None:
            self._stroke = paint.drawn_to(self._stroke, *self._cursor(), view.brush, density)
            painted = paint.painted(self._stroke, view.brush.mode)
            self.work = replace(self.work, view=stack.with_paint(view, focus, painted))

    def _dragged(self) -> bool:
        """Whether the left button moved between its press and its release, by more than a hand trembles."""
        moved = imgui.get_mouse_drag_delta(0, CLICK_PX * self.ui.scale)
        return bool(moved.x or moved.y)

    def _cursor(self) -> tuple[float, float]:
        """Where the mouse is, in pixels of the picture."""
        mouse, density = imgui.get_io().mouse_pos, imgui.get_io().display_framebuffer_scale
        return mouse.x * density.x, mouse.y * density.y

    def _focus_picked(self, camera: ViewCamera) -> None:
        """A click on the picture: the layer there, if there is one, is focused."""
        view = self._shown()
        seen = seen_at(
            self.engine.gaussians(view),
            to_camera(camera, *self._picture_size()),
            *self._cursor(),
            self.engine.near,
        )
        layer = None if seen is None else layer_at(view, self.engine.gdfs, seen)
        if layer is not None:
            self._perform(f"focus:{layer + 1}")

    def _pivot_picked(self, camera: ViewCamera) -> ViewCamera:
        scene = self.engine.gaussians(self._shown())
        point = surface_point(
            scene, to_camera(camera, *self._picture_size()), *self._cursor(), self.engine.near
        )
        return camera if point is None else controls.pivot_on(camera, point, self.facts.bounds.radius)

    def _shown(self) -> ViewState:
        return workspace.original(self.work.view) if inputs.holds_original(self._keys) else self.work.view

    def _draw_picture(self, screen: moderngl.Framebuffer) -> None:
        """The splats; the engine works only where what is shown is another picture than its last one."""
        view, size = self._shown(), self._picture_size()
        screen.use()
        screen.clear(*PALETTE.panel)
        aim, edits = (view.camera, size), (view.layers, view.blend, view.background)
        turned, slid = aim != self._last_shown[0], edits != self._last_shown[1]
        self._last_shown = aim, edits
        mode = "off" if view.compare.mode == "difference" else view.draft
        self._draft = draft.begun(self._draft, mode, self._held(), turned, slid, self._clock)
        new = self.comparer.needs_draw(view, size, self._draft.pixels)
        timings = self.comparer.draw(view, screen, size, self._draft.pixels)
        if new:
            self.timings = timings
            self.drawn += 1
            self._draft = draft.drawn(self._draft, timings, turned)

    def _held(self) -> bool:
        """Whether a hand is on something that moves the picture, or a film plays."""
        if self._drag is not None or imgui.is_any_item_active() or imgui.get_io().mouse_wheel:
            return True
        return inputs.flying(self._keys) or inputs.repeating(self._keys) or self.work.player.playing

    def _cards(self) -> tuple[SnapshotCard, ...]:
        """The snapshots as the panel shows them; drawn one a frame."""
        work = self.work
        if not work.snapshots:
            return ()
        kept = shown(work.snapshots, work.view)
        textures, missing = self.thumbnails.bring(kept, work.view)
        if missing:
            self.wake()
        return tuple(SnapshotCard(s.name, texture) for s, texture in zip(kept, textures, strict=True))

    def _ask(self) -> None:
        """The question that is open, if one is."""
        if self.work.dialog is None:
            return
        area = self._area()
        pressed = [press.chord for press in self._keys.pressed]
        answer = dialogs.draw(self.work.dialog, self.recent, pressed, self.ui, area)
        if answer.dialog is None:
            self.wake()
        requests = (*self.work.requests, *answer.requests)
        self.work = replace(self.work, dialog=answer.dialog, requests=requests)

    def _draw_overlays(self) -> None:
        self._ask()
        area, work = self._area(), self.work
        if work.view.brush.active and not imgui.get_io().want_capture_mouse:
            brush.ring(work.view, self.ui)
        if inputs.holds_original(self._keys):
            overlay.banner("Original", area, self.ui)
        else:
            held = self._grips_divider()
            compare_overlay.draw(work.view, self.comparer.psnr, area, held, self.ui)
        if work.view.overlay:
            overlay.table(self.figures(), self.ui)
        if work.help:
            overlay.bindings(area, self.ui)
        if work.message is not None:
            bar = timeline_bar.height(work.player, self.ui) if work.view.panel else 0.0
            closed = overlay.message(work.message, replace(area, height=area.height - bar), self.ui)
            if closed or self._clock >= work.message.until:
                self.work = replace(work, message=None)
                self.wake()

    def figures(self) -> list[tuple[str, str]]:
        """What the overlay shows of the picture on screen."""
        drawn = drawn_size(self._picture_size(), self._draft.pixels)
        count, by = self.facts.count, self.engine.draws_with
        return overlay.figures(self.timings, self.latencies_ms, count, by, drawn, self._draft.pixels)

    def ask(self, dialog: Dialog) -> None:
        """Open a question over the picture."""
        self.work = replace(self.work, dialog=dialog)
        self.wake()

    def request(self, request: str) -> None:
        """One more thing for the window to do, after the next frame."""
        self.work = replace(self.work, requests=(*self.work.requests, request))
        self.wake()

    def take_requests(self) -> tuple[str, ...]:
        """What the window shall do now; asked for once each."""
        requests, self.work = self.work.requests, replace(self.work, requests=())
        return requests

    def _save_pictures(self, screen: moderngl.Framebuffer, size: tuple[int, int]) -> None:
        if "picture" in self.work.requests:
            image = self.comparer.image(self._shown(), self._picture_size())
            self._save(labelled(image, self._shown().compare, self.comparer.psnr))
        if "window_picture" in self.work.requests:
            self._save(read_rgb(screen, size))
        if "timeline_file" in self.work.requests:
            self._save_timeline()
        done = ("picture", "window_picture", "timeline_file")
        left = tuple(r for r in self.work.requests if r not in done)
        self.work = replace(self.work, requests=left)

    def _save_timeline(self) -> None:
        view = self.work.view
        path = free_path(self.pictures, f"{Path(self.facts.title).stem}_timeline", ".json")
        try:
            timeline_file.save(path, view.timeline, view.layers)
        except ProgdfError as error:
            self.tell(str(error), error=True)
        except OSError as error:
            self.tell(f"no timeline was saved in {self.pictures.resolve()}: {error.strerror}", error=True)
        else:
            self.tell(f"Saved {path.resolve()}; progdf render … --timeline {path.name} makes a film of it")

    def _save(self, image: NDArray[np.uint8]) -> None:
        try:
            path = save_picture(self.pictures, Path(self.facts.title).stem, image)
        except ProgdfError as error:
            self.tell(str(error), error=True)
        except OSError as error:
            self.tell(f"no picture was saved in {self.pictures.resolve()}: {error.strerror}", error=True)
        else:
            self.tell(f"Saved {path.resolve()}")


def _strengths(view: ViewState) -> list[float]:
    return [layer.strength for layer in view.layers]
