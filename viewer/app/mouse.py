"""The mouse on the picture: drags of the camera, the divider and the brush, clicks that pick."""

from __future__ import annotations

from dataclasses import dataclass, replace

from imgui_bundle import imgui

from progdf.camera import Camera
from viewer.camera import controls, inputs
from viewer.camera.view_camera import ViewCamera, to_camera
from viewer.panel import brush
from viewer.render.engine import Engine
from viewer.render.picking import layer_at, seen_at, surface_point
from viewer.state import layers as stack
from viewer.state import paint, workspace
from viewer.state.paint import Stroke
from viewer.state.view_state import ViewState
from viewer.state.workspace import SceneFacts, Workspace
from viewer.ui.context import UiContext
from viewer.ui.overlay import Area

from . import compare_overlay

CLICK_PX = 3.0  # a press that moves no further, at 1×, is a click


@dataclass(frozen=True)
class Hand:
    """What the mouse holds.

    Args:
        drag: one of `controls.DRAGS`, `compare_overlay.DIVIDER` or `brush.DRAG`; None while it holds nothing
        stroke: of the brush, from its first drag on
        divider: where that of a split stood when it was gripped, share of the picture's width
    """

    drag: str | None = None
    stroke: Stroke | None = None
    divider: float = 0.5


@dataclass(frozen=True)
class Sight:
    """What lies under the hand in one frame.

    Args:
        engine: draws the picture
        facts: of the open scene
        shown: what the picture shows: the state, or the original while its key is held
        area: the part of the window that shows it
        ui: fonts and scale
        now: seconds on the stage's clock
    """

    engine: Engine
    facts: SceneFacts
    shown: ViewState
    area: Area
    ui: UiContext
    now: float

    @property
    def size(self) -> tuple[int, int]:
        """The picture's width and height in framebuffer pixels."""
        density = imgui.get_io().display_framebuffer_scale
        return max(round(self.area.width * density.x), 1), max(round(self.area.height * density.y), 1)

    @property
    def cursor(self) -> tuple[float, float]:
        """Where the mouse is, in pixels of the picture."""
        mouse, density = imgui.get_io().mouse_pos, imgui.get_io().display_framebuffer_scale
        return mouse.x * density.x, mouse.y * density.y

    def camera(self, camera: ViewCamera) -> Camera:
        """`camera` as it takes the picture."""
        return to_camera(camera, *self.size)


def moved(hand: Hand, work: Workspace, sight: Sight) -> tuple[Hand, Workspace]:
    """What the mouse did in this frame, as imgui's io has it."""
    io = imgui.get_io()
    hand, work = _dragged(hand, work, sight)
    if imgui.is_mouse_released(0) and hand.drag in ("orbit", "look") and not _travelled(sight.ui):
        work = _focus_picked(work, sight)
    if not inputs.any_button_down():
        hand = replace(hand, drag=None)
    if io.want_capture_mouse:
        return hand, work
    if grips_divider(hand, work.view, sight):
        compare_overlay.show_grip()
        if imgui.is_mouse_clicked(0):
            return Hand(compare_overlay.DIVIDER, divider=work.view.compare.divider), work
    if work.view.brush.active and imgui.is_mouse_clicked(0):
        return _stroke_begun(hand, work, sight)
    camera = work.view.camera
    if imgui.is_mouse_double_clicked(0):
        return hand, workspace.with_camera(work, _pivot_picked(camera, sight))
    hand = replace(hand, drag=inputs.drag_begun(camera.mode) or hand.drag)
    if io.mouse_wheel:
        work = workspace.with_camera(work, controls.zoom(camera, io.mouse_wheel, sight.facts.bounds.radius))
    return hand, work


def called_off(hand: Hand, work: Workspace) -> Workspace:
    """What is dragged goes back to where it was; undo knows where, but for the divider, which is no edit."""
    work = workspace.called_off(work)
    if hand.drag != compare_overlay.DIVIDER:
        return work
    return replace(work, view=compare_overlay.placed(work.view, hand.divider))


def grips_divider(hand: Hand, view: ViewState, sight: Sight) -> bool:
    """Whether the divider of a split is in the hand, or under it."""
    if hand.drag is not None:
        return hand.drag == compare_overlay.DIVIDER
    over = imgui.get_io().want_capture_mouse
    return not over and compare_overlay.near(view, sight.area, sight.ui)


def _dragged(hand: Hand, work: Workspace, sight: Sight) -> tuple[Hand, Workspace]:
    """What is held follows the mouse."""
    io, scale = imgui.get_io(), sight.ui.scale
    dx, dy = io.mouse_delta.x / scale, io.mouse_delta.y / scale
    if hand.drag == compare_overlay.DIVIDER:
        return hand, replace(work, view=compare_overlay.moved(work.view, sight.area))
    if hand.drag == brush.DRAG:
        return _painted(hand, work, sight)
    if hand.drag and (dx or dy):
        # also where the button went up within this frame: a slow frame must not lose the end of a drag
        height, radius = sight.area.height / scale, sight.facts.bounds.radius
        camera = controls.drag(work.view.camera, hand.drag, dx, dy, height, radius)
        return hand, workspace.with_camera(work, camera)
    return hand, work


def _stroke_begun(hand: Hand, work: Workspace, sight: Sight) -> tuple[Hand, Workspace]:
    """The brush comes down on the focused layer, or says why it cannot."""
    reason = brush.obstacle(work.view, work.focus)
    if reason or work.focus is None:
        return hand, workspace.told(work, f"Cannot paint: {reason}", sight.now, error=True)
    layer, camera = work.view.layers[work.focus], sight.camera(work.view.camera)
    scene, held = sight.engine.gaussians(work.view), work.view.brush
    mode = paint.mode_while(held.mode, inputs.modifier())
    stroke = paint.begun(layer.paint, sight.engine.gdfs[layer.gdf], scene, camera, held.through, mode)
    return _painted(Hand(brush.DRAG, stroke), work, sight)


def _painted(hand: Hand, work: Workspace, sight: Sight) -> tuple[Hand, Workspace]:
    """The brush moves to the cursor; what it has painted so far is shown at once."""
    view, focus = work.view, work.focus
    if hand.stroke is None or focus is None:
        return hand, work
    density = imgui.get_io().display_framebuffer_scale.x * sight.ui.scale
    stroke = paint.drawn_to(hand.stroke, *sight.cursor, view.brush, density)
    painted = stack.with_paint(view, focus, paint.painted(stroke, view.brush, density))
    return replace(hand, stroke=stroke), replace(work, view=painted)


def _travelled(ui: UiContext) -> bool:
    """Whether the left button moved between its press and its release, by more than a hand trembles."""
    way = imgui.get_mouse_drag_delta(0, CLICK_PX * ui.scale)
    return bool(way.x or way.y)


def _focus_picked(work: Workspace, sight: Sight) -> Workspace:
    """A click on the picture: the layer there, if there is one, is focused."""
    engine, view = sight.engine, sight.shown
    camera = sight.camera(work.view.camera)
    seen = seen_at(engine.gaussians(view), camera, *sight.cursor, engine.near)
    layer = None if seen is None else layer_at(view, engine.gdfs, seen)
    return work if layer is None else workspace.focused(work, layer)


def _pivot_picked(camera: ViewCamera, sight: Sight) -> ViewCamera:
    """A double click: what lies under the cursor becomes the pivot."""
    engine = sight.engine
    scene = engine.gaussians(sight.shown)
    point = surface_point(scene, sight.camera(camera), *sight.cursor, engine.near)
    return camera if point is None else controls.pivot_on(camera, point, sight.facts.bounds.radius)
