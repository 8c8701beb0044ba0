"""Main view of a window: input → workspace → picture → screen. Uses imgui and GL, but no windowing system.

The window (app.py) and the tests fill imgui's io and call `frame`, so scripted input takes the same path as
real input.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import moderngl
from imgui_bundle import imgui

from progdf.errors import ProgdfError
from viewer.files import exports
from viewer.gl.present import read_rgb
from viewer.panel import new_edit_form, pages, panel, timeline_bar, tools
from viewer.pictures.film import Pixels
from viewer.render.decal_surfaces import DecalSurfaces
from viewer.render.engine import ViewEngine
from viewer.render.paint_overlay import PaintOverlay
from viewer.render.picking import Surfaces
from viewer.state import actions, layer_selection, timeline, workspace
from viewer.state.commands import Action, Plain, WithValue
from viewer.state.forms import NewEdit
from viewer.state.layers import add_layer
from viewer.state.snapshots import SliderSnapshot, compare_sides
from viewer.state.transient import Decal, Gizmo, KeyPointer, MouseTool, PreviewState, Pull
from viewer.state.view_state import LayerState, ViewState
from viewer.state.workspace import PLACES, SceneFacts, Store, Workspace, with_transient
from viewer.ui import fonts, overlay
from viewer.ui.context import UiContext
from viewer.ui.keys import (
    COMMANDS,
    NO_KEYS,
    Keys,
    PendingKeys,
    cancels_drag,
    fly_by_keys,
    has_pending_input,
    is_flying,
    is_repeating,
    requested_commands,
)
from viewer.ui.pointer import PointerContext

from . import color_tool, handles, interface, mouse, select_tool
from .canvas import Canvas, FramePacer, LayersOf, RememberView, forget_view, no_layers
from .decal import (
    SURFACE_POLL_S,
    DecalPlace,
    decal_takes_mouse,
    draw_decal,
    draw_ghosts,
    frame_delays,
    place_decal,
)
from .inspect import frusta
from .inspect.readouts import Inspection
from .messages import Messages
from .pull import tool as pull_tool

FIT_POLL_S = 0.25  # seconds between frames while the surface under paint or a histogram is computed
FLIGHT_S = 1 / 60  # seconds between frames while flying


class MainView:
    """Window content that draws frames of one engine into a given framebuffer.

    Args:
        context: the GL context of the engine
        engine: draws the picture
        facts: data of the open scene
        view: initial view
        scale: window pixels per design pixel (see UiContext)
        pictures: folder for saved pictures
    """

    def __init__(
        self,
        context: moderngl.Context,
        engine: ViewEngine,
        facts: SceneFacts,
        view: ViewState,
        scale: float = 1.0,
        pictures: Path = Path(),
    ) -> None:
        self.context = context
        self.engine = engine
        self.facts = facts
        self.pictures = pictures
        self.canvas = Canvas(context, engine)
        self.report: Callable[[Exception], None] = self._report  # receives the errors of a part of a frame
        self.remember: RememberView = forget_view  # receives the saved pictures of single views
        self.follow_input: Callable[[], object] = lambda: None  # starts work on the input of a frame
        self.layers_of: LayersOf = no_layers  # returns the layers of a view for a picture's metadata
        self.surfaces = Surfaces()
        self.decal_surfaces = DecalSurfaces()
        self.inspection = Inspection()
        self.paint = PaintOverlay(context)
        self.ui = UiContext(scale)
        imgui.backends.opengl3_init("#version 330")
        self._pace = FramePacer()
        self.wake = self._pace.wake
        self._clock = 0.0
        self.store = Store(workspace.new_workspace(view), self.wake)
        self.messages = Messages(self.store, lambda: self._clock)
        self.frames = 0  # number of frames drawn
        # the layer shown in the panel, and whether several are selected
        self._revealed = (self.work.focus, False)
        self._keys = NO_KEYS  # keys of the current frame
        self._held = False  # an item of the interface was active in the last frame, by mouse or keyboard
        self._popups = 0, 0  # number of open popups at the start of the last frame and of this one
        self._half = 0  # picture under the mouse if two are side by side: 0 left, 1 right
        self._pending = PendingKeys()
        self._resting = False

    @property
    def work(self) -> Workspace:
        """State of the window."""
        return self.store.get()

    def rest(self) -> None:
        """Stop drawing until the next frame, as the window is minimized."""
        self._pace.rest()
        self._resting = True

    def close(self) -> None:
        """Free the resources of the main view; the caller owns the engine and the context."""
        self.ui.make_current()
        imgui.backends.opengl3_shutdown()
        self.ui.close()
        self.surfaces.drop()
        self.decal_surfaces.drop()
        self.inspection.distributions.drop()
        self.paint.release()
        self.canvas.release()

    def set_engine(self, engine: ViewEngine, facts: SceneFacts, live: tuple[LayerState, ...] = ()) -> None:
        """Draw with another engine from now on (the scene or its edits have changed).

        Args:
            live: layers of the edits in training; in the engine these edits follow those of the facts
        """
        self.canvas.release()
        self.surfaces.drop()
        if engine.scene is not self.engine.scene:
            self.decal_surfaces.drop()
        self.paint.drop()
        self.engine = engine
        self.facts = facts
        self.store.replace(with_transient(self.work, live=live))
        self.canvas = Canvas(self.context, engine, self.canvas)
        self.wake()

    def restart(self, view: ViewState, snapshots: tuple[SliderSnapshot, ...] = ()) -> None:
        """Set a new state and snapshots, without undo history, drag, tour or anything over the picture."""
        old = self.work.transient
        transient = replace(
            old,
            cover=None,
            preview=PreviewState(),
            gizmo=None,
            tool=MouseTool(),
            clone=None,
            pending=(),
            viewpoints=(),
            through=None,
            tour=None,
        )
        self.store.replace(
            replace(
                workspace.new_workspace(view, snapshots),
                layout=self.work.layout,
                form=NewEdit(outside=self.work.form.outside),
                transient=transient,
            )
        )
        self.wake()

    def next_frame_delay(self) -> float | None:
        """Return the seconds that the window may wait for an event before the next frame; None: no limit."""
        self.ui.make_current()
        if not self._resting and (has_pending_input() or self.opening):
            return 0.0
        waits = [FLIGHT_S] if is_flying(self._keys) else []
        if self.work.glide is not None:
            waits.append(0.0)
        if self.work.message is not None:
            waits.append(max(self.work.message.until - self._clock, 0.0))
        waits += frame_delays(self.work.transient.gizmo, self.decal_surfaces.is_busy, self._clock)
        sharpens = self.canvas.next_frame_delay(self._clock)
        waits += [] if sharpens is None else [sharpens]
        waits += [SURFACE_POLL_S] if self.paint.pending else []
        waits += [FIT_POLL_S] if self.paint.fits.is_busy or self.inspection.distributions.is_busy else []
        film = timeline.next_frame_delay(self.work.player, self.work.view.timeline)
        return self._pace.next_frame_delay(waits if film is None else [*waits, film])

    def is_due(self) -> bool:
        """Return True if a frame would show anything new.

        A frame that could only poll an unfinished picture does not count. With a software renderer it would
        slow that picture down.
        """
        return self.next_frame_delay() == 0.0 or not self.canvas.awaits_picture()

    def frame(self, screen: moderngl.Framebuffer, seconds: float, keys: Keys = NO_KEYS) -> None:
        """Handle the input in imgui's io, and draw.

        Args:
            screen: the framebuffer to draw into
            seconds: time since the last frame
            keys: keyboard input of this frame
        """
        self.ui.make_current()
        imgui.get_io().delta_time = max(seconds, 1e-5)
        self._clock += max(seconds, 0.0)
        self._pace.step(seconds)
        self.inspection.step(seconds)
        self._resting = False
        with self._guard():
            self.store.replace(workspace.advance(self.work, seconds))
        with self._guard():
            if missing := self.ui.fallbacks.cover(interface.texts_of(self.work, self.facts)):
                self.messages.show(fonts.missing_message(missing))
        imgui.backends.opengl3_new_frame()
        imgui.new_frame()
        with self._guard():
            self._update(keys, seconds)
        with self._guard():
            self.follow_input()
        with self._guard():
            self._draw_picture(screen)
        with self._guard():
            self._draw_overlays()
        imgui.render()
        screen.use()
        imgui.backends.opengl3_render_draw_data(imgui.get_draw_data())
        self.frames += 1
        self._save_files(screen)

    def _guard(self) -> AbstractContextManager[None]:
        return self.ui.guard(self.report)

    def _report(self, error: Exception) -> None:
        """Handle an error without an application: show user-facing errors, raise internal ones."""
        if not isinstance(error, ProgdfError):
            raise error
        self.messages.show(str(error), error=True)

    def _update(self, keys: Keys, seconds: float) -> None:
        """Update the workspace from the user's input."""
        before = self.work
        self._keys = self._pending.take(keys)
        self._handle_input(seconds)
        self._held = bool(imgui.is_any_item_active())
        held = self._held or self.work.transient.tool.drag is not None
        if not (held or is_repeating(keys) or is_flying(self._keys)):
            self.store.replace(workspace.record_undo(self.work))
        if self.work.view.layers != before.view.layers:
            self.store.replace(replace(self.work, before=False))
        self.store.replace(frusta.leave_camera(self.work))
        if self.work != before:
            self.store.replace(actions.end_at_edit(before, self.work))
            self.wake()

    def _draw_picture(self, screen: moderngl.Framebuffer) -> None:
        view = self._displayed_view()
        area = self.pointer().size
        self.canvas.comparer.sides = compare_sides(self.work.snapshots, view)
        self.canvas.comparer.photograph = frusta.compared_view(self.work, self.work.view)[1]
        pointed = self.work.pointed if view.panel else None
        held = self._is_held()
        transient = self.work.transient
        live = bool(transient.live)
        pull = transient.held_pull
        pulled = None if pull is None else pull.influence
        focus = self.work.focus
        guessed = select_tool.guessed_rows(self.work)
        self.canvas.compares_grade = self.work.form_open and self.work.before
        self.canvas.draw(
            view, screen, area, held, self._clock, focus, pointed, live, pulled=pulled, guessed=guessed
        )
        if self.canvas.pixels == 1 and not self._is_held():
            self.pointer().look_ahead()

    @property
    def at_start(self) -> bool:
        """True if nothing is open, so that the start page is visible."""
        return not self.facts.title

    @property
    def opening(self) -> bool:
        """True if a text field is about to get the keyboard: text typed now would be lost."""
        return not self._resting and self._pending.opening

    def _area(self) -> overlay.Area:
        """Return the part of the window that shows the picture."""
        display = imgui.get_io().display_size
        wide = panel.width(self.work.layout, self.ui) if self.work.view.panel and not self.at_start else 0.0
        return overlay.Area(max(display.x - wide, 1.0), max(display.y, 1.0))

    def _handle_input(self, seconds: float) -> None:
        off = cancels_drag(self._keys, self._held, self.work.transient.tool.drag)
        if off:
            self._cancel_drag()
        asks = self._takes_keys()
        self._follow_keyboard(asks)
        if not asks:
            work, self._keys = interface.take_keys(self.work, self.pointer(), self._keys)
            self.store.replace(work)
        self._point_by_keys(asks)
        if asks:  # no key is a shortcut or flies
            self._keys = Keys(self._keys.pressed)
        for command in requested_commands(self._keys):
            placing = command.id == "rename" and self.work.transient.gizmo is not None
            if placing or (self.at_start and command.id not in pages.COMMANDS):
                continue  # Enter keeps the handles
            # window_picture saves the open window and changes nothing
            if not asks or command.id == "window_picture":
                self._perform(command.action)
        if self.at_start:
            transient = self.work.transient
            for action in pages.draw_start_page(transient.start_files, transient.examples, self.ui):
                self._perform(action)
            return
        if is_flying(self._keys):
            flown = fly_by_keys(self.work.view.camera, self._keys, seconds, self.facts.bounds.radius)
            self.store.replace(workspace.with_camera(self.work, flown))
        if self.work.view.panel:
            several = len(layer_selection.selected_layers(self.work)) > 1
            reveal = self._revealed != (self.work.focus, several)
            with self._guard():
                pictures, missing = self.canvas.thumbnails(self.work, self.facts.rows)
                if missing:
                    self.wake()
                compared = self.canvas.comparer.labels(self.work.view), self.work.before
                self.store.replace(
                    interface.panels(
                        self.work, self.pointer(), pictures, reveal, compared, self.inspection.distributions
                    )
                )
            self._revealed = self.work.focus, several
        held = self.work.transient.tool.drag is None and self._move_gizmo()
        if not off and not held:  # else the right button was only pressed to cancel the drag
            work = self.work
            pointer = self.pointer()
            self.store.replace(with_transient(work, tool=MouseTool()))  # the drag ends if it raises
            with self._guard():
                self.store.replace(mouse.handle_mouse(work, pointer))

    def _point_by_keys(self, asks: bool) -> None:
        """Move the pointer of the active tool by keys."""
        work = self.work
        held = work.transient.pointer
        decal = isinstance(work.transient.gizmo, Decal)
        if work.transient.gizmo is not None and "Enter" in [press.chord for press in self._keys.pressed]:
            return  # it keeps the decal or the handles where they are, see `_move_gizmo`
        picks = work.form_open and work.form.picks
        if isinstance(work.transient.gizmo, Decal | Pull) or not pull_tool.is_free(work):
            clicks = decal or picks or work.view.select.tool in select_tool.CLICKED
            if not (asks or self.at_start or imgui.get_io().want_text_input):
                held, self._keys = mouse.point_by_keys(held, self._keys, self.pointer(), clicks)
                self.store.replace(with_transient(work, pointer=held))
        elif held.at or held.down:
            mouse.let_go(held)
            self.store.replace(with_transient(work, pointer=KeyPointer()))

    def _follow_keyboard(self, asks: bool) -> None:
        """Restrict the keys while a part of the window has the keyboard.

        That part takes all keys but F1 to F12 and those with Ctrl, until a click or Escape.

        Args:
            asks: a dialog or menu lies over the part
        """
        if self.work.keyboard and not asks:
            pressed = {press.chord for press in self._keys.pressed}
            leaves = "Escape" in pressed and not self._held
            if leaves or any(imgui.is_mouse_clicked(button) for button in range(3)):
                self.store.replace(replace(self.work, keyboard=""))
            left = [
                p for p in self._keys.pressed if p.chord.startswith("Ctrl+") or re.search(r"F\d", p.chord)
            ]
            self._keys = replace(self._keys, pressed=tuple(left), fly=frozenset())
        windows = {name: imgui.internal.find_window_by_name(name) for name in PLACES}
        shown = [name for name, window in windows.items() if window is not None and window.was_active]
        while self.work.keyboard and self.work.keyboard not in shown:
            self._perform(WithValue("next_place", self.work.keyboard_by))
        self.ui.keyboard = self.work.keyboard
        self.ui.focused = self.ui.focused if self.work.keyboard else ""

    def _move_gizmo(self) -> bool:
        """Move the handles or the decal with the mouse; return True if they take the mouse."""
        gizmo = self.work.transient.gizmo
        pressed = [press.chord for press in self._keys.pressed]
        moved = gizmo
        asked = ""
        takes_mouse = False
        with self._guard():  # Escape also leaves handles that cannot be drawn
            draw_ghosts(self.work.transient, self.pointer())
            if isinstance(gizmo, Gizmo):
                moved, asked = handles.draw_gizmo(gizmo, self.pointer(), self.decal_surfaces)
                takes_mouse = handles.gizmo_takes_mouse(gizmo, moved)
            elif isinstance(gizmo, Pull):
                moved, asked, takes_mouse = pull_tool.update(
                    gizmo, self.work, self.pointer(), self.decal_surfaces, pressed
                )
            elif gizmo is not None:
                moved, asked = draw_decal(gizmo, self.pointer(), self.decal_surfaces, "Enter" in pressed)
                takes_mouse = decal_takes_mouse(moved, self.pointer())
        if gizmo is None:
            return False
        self.store.replace(with_transient(self.work, gizmo=moved))
        if "Escape" in pressed or "Enter" in pressed:
            asked = gizmo.escape_request if "Escape" in pressed else gizmo.enter_request
        if asked:
            self.messages.request(Plain(asked))
        if moved != gizmo or (isinstance(moved, Gizmo) and moved.using):
            self.wake()
        return takes_mouse

    def decal_place(self) -> DecalPlace | None:
        """Return the decal being placed, the camera that projects it, and its position in that picture.

        Raises:
            ProgdfError: there is no surface under the decal.
        """
        decal = self.work.transient.gizmo
        if not isinstance(decal, Decal):
            return None
        return decal, *place_decal(decal)

    def _takes_keys(self) -> bool:
        """Return True if a dialog, list, menu or form takes all keys, or Escape has just closed one."""
        self._popups = self._popups[1], len(imgui.get_current_context().open_popup_stack)
        form = self.work.form_open and new_edit_form.has_keyboard()
        return self.work.dialog is not None or max(self._popups) > 0 or form

    def _cancel_drag(self) -> None:
        """Restore the state from before the drag and end the drag."""
        work = mouse.cancel_drag(self.work)
        self.store.replace(with_transient(work, pointer=mouse.let_go(work.transient.pointer)))
        imgui.internal.clear_active_id()
        self._keys = replace(self._keys, pressed=())

    def _perform(self, action: Action) -> None:
        with self._guard():
            self.store.replace(interface.perform_actions(self.work, [action], self.pointer()))

    def pointer(self) -> PointerContext:
        """Return the context of the pointer: scene, area and displayed view."""
        area = self._area()
        if self.work.transient.tool.drag is None:
            self._half = int(2 * imgui.get_io().mouse_pos.x >= area.width)
        return PointerContext(
            self.engine,
            self.facts,
            self._displayed_view(),
            area,
            self.ui,
            self._clock,
            self.surfaces,
            self.paint,
            half=self._half,
        )

    def _displayed_view(self) -> ViewState:
        view = self.work.view
        frame = self._frame()
        if frame is not None:
            view = overlay.fit_to_frame(view, frame, self._area())
        view, photograph = frusta.compared_view(self.work, view)
        if self.work.before and photograph is None:
            return workspace.original(view)
        sides = compare_sides(self.work.snapshots, view)
        if sides is not None:
            return sides.right
        transient = self.work.transient
        for layer in transient.live:
            view = add_layer(view, layer.gdf, layer.name, layer.strength)
        # the live edit is theirs, not from training
        moved = self.work.form_open or transient.gizmo is not None
        if transient.live and moved and transient.tool.gesture is None:
            view = replace(view, select=replace(view.select, tool=""))
        return view

    def _frame(self) -> overlay.Area | None:
        """Return the size of the safe frame; None while an image lies over the picture."""
        area = self._area()
        covered = timeline_bar.height(self.work, self._area(), self.ui)
        if self.work.transient.cover is not None:
            return None
        return overlay.safe_frame(self.work.view, area, covered)

    def _is_held(self) -> bool:
        """Return True if the user's input or a playing film moves the picture."""
        transient = self.work.transient
        is_dragged = transient.tool.drag is not None or transient.held_pull is not None
        if is_dragged or imgui.is_any_item_active() or imgui.get_io().mouse_wheel:
            return True
        moves = self.work.player.playing or self.work.glide is not None
        return moves or is_flying(self._keys) or is_repeating(self._keys)

    def _draw_overlays(self) -> None:
        """Draw the overlays of the picture; request another frame if one of them disappears."""
        pointer = self.pointer()
        before = self.work
        over = max(self._popups) > 1  # a list over the dialog takes its keys
        pressed = [] if over else [press.chord for press in self._keys.pressed]
        with self._guard():
            self.store.replace(interface.draw_dialog(self.work, pointer, pressed))
        original = self.work.before
        with self._guard():
            color_tool.draw(self.work, pointer)
        with self._guard():
            if not original:
                pages.draw_cover(self.work, pointer.size, pointer.area, self.ui)
        if (frame := self._frame()) is not None:
            overlay.draw_frame(self.work.view.safe_frame, frame, pointer.area, self.ui)
        with self._guard():
            offered = pages.COMMANDS if self.at_start else [a for a, c in COMMANDS.items() if not c.in_hand]
            self.store.replace(interface.draw_lists(self.work, pointer, offered, pressed))
        labels = self.canvas.comparer.labels(self.work.view)
        self.store.replace(interface.over_picture(self.work, pointer, labels, original))
        with self._guard():
            textures, missing = self.canvas.photographs(frusta.thumbnails(self.work.transient.viewpoints))
            frusta.draw(self.work, pointer, textures)
            left = tools.LEFT_PX * self.ui.scale
            self.inspection.draw(self.work, pointer, self.canvas.timings.total_ms, left)
            if missing:
                self.wake()
        gone = (before.dialog, self.work.dialog), (before.message, self.work.message)
        if any(was is not None and now is None for was, now in gone):
            self.wake()

    @property
    def picture_size(self) -> tuple[int, int]:
        """Width and height of the picture on screen, in pixels."""
        return self.pointer().size

    def take_requests(self) -> tuple[Action, ...]:
        """Return the pending requests of the window and clear them."""
        requests = self.work.requests
        self.store.replace(replace(self.work, requests=()))
        return requests

    def save_original(self, folder: Path, name: str) -> Path:
        """Write the picture on screen without edits into a folder; return its path, which begins with `name`.

        Raises:
            ProgdfError: see `exports.picture`.
        """
        view = workspace.original(self.work.view)
        return self.canvas.save_whole(folder, name, view, self.picture_size, None, self.remember)

    def save_edited(self, folder: Path, name: str) -> Path:
        """Write the picture on screen with the visible layers and their strengths, see `save_original`.

        Raises:
            ProgdfError: see `exports.picture`, or a visible edit has no file that the picture can name.
        """
        view = self.work.view
        layers = self.layers_of(view)
        return self.canvas.save_whole(folder, name, view, self.picture_size, layers, self.remember)

    def original_picture(self) -> Pixels:
        """Return the picture on screen without edits. [H,W,3]"""
        return self.canvas.whole(workspace.original(self.work.view), self.picture_size)

    def _save_files(self, screen: moderngl.Framebuffer) -> None:
        """Serve the requests for files that need only the main view."""
        served = [request for request in self.work.requests if request.name in exports.REQUESTS]
        unserved = tuple(request for request in self.work.requests if request not in served)
        self.store.replace(replace(self.work, requests=unserved))
        for request in served:
            with self._guard():
                self.messages.show(self._save(request.name, screen))

    def _save(self, request: str, screen: moderngl.Framebuffer) -> str:
        title = self.facts.title
        view = replace(self._displayed_view(), camera=self.work.view.camera)
        if request == "window_picture":
            display = imgui.get_io().display_size
            density = imgui.get_io().display_framebuffer_scale
            whole = round(display.x * density.x), round(display.y * density.y)
            return f"Saved {exports.picture(self.pictures, title, read_rgb(screen, whole))}"
        if request == "take_view":
            taken = self.save_original(self.pictures, title)
            return f"Saved {taken}. Edit it in any program and drop it here."
        layers = None
        with contextlib.suppress(ProgdfError):  # the picture has the names of the edits alone
            layers = self.layers_of(view)
        return self.canvas.save(self.pictures, title, view, self.pointer().size, layers, self.remember)
