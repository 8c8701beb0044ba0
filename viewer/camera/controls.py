"""What the mouse and the keys do to the camera, as pure functions, and the table of bindings, as data.

Pixels are window coordinates at 1× (the caller divides by the UI scale), angles degrees, lengths world units.
No function ever returns a camera that is not finite: a move that would leave the numbers is not made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from .up_axis import Vec3
from .view_camera import FARTHEST, ViewCamera, add_scaled, axes, eye, look_from, unit

DEGREES_PER_PIXEL = 0.3
ZOOM_PER_STEP = 0.12  # of the distance, per wheel step
DOLLY_PER_PIXEL = 0.005
FLY_RADII_PER_SECOND = 0.6
CLOSEST, WIDEST = 1e-4, 1e4  # of the scene's radius: how near to and far from the pivot the eye goes


def orbit(camera: ViewCamera, dx: float, dy: float) -> ViewCamera:
    """Turn around the pivot so that the scene follows the mouse; stops at the poles."""
    elevation = max(-90.0, min(90.0, camera.elevation + DEGREES_PER_PIXEL * dy))
    azimuth = _wrap_degrees(camera.azimuth - DEGREES_PER_PIXEL * dx)
    return _keep_finite(replace(camera, azimuth=azimuth, elevation=elevation), camera)


def look(camera: ViewCamera, dx: float, dy: float) -> ViewCamera:
    """Turn the view with the eye fixed (fly mode): right looks right, down looks down."""
    turned = orbit(camera, dx, dy)
    position = eye(camera)
    return _keep_finite(
        replace(turned, pivot=add_scaled(position, (-camera.distance, axes(turned).back))), camera
    )


def pan(camera: ViewCamera, dx: float, dy: float, height: float) -> ViewCamera:
    """Slide the view so that what lies at the pivot's depth stays under the cursor.

    Args:
        height: of the picture in the same pixels as dx and dy
    """
    per_pixel = 2.0 * camera.distance * math.tan(math.radians(camera.fov_y) / 2) / max(height, 1.0)
    picture = axes(camera)
    pivot = add_scaled(camera.pivot, (-dx * per_pixel, picture.right), (dy * per_pixel, picture.up))
    return _keep_finite(replace(camera, pivot=pivot), camera)


def zoom(camera: ViewCamera, steps: float, radius: float) -> ViewCamera:
    """Wheel: steps > 0 goes nearer, in proportion to the distance.

    Args:
        radius: of the scene, world units; bounds the distance
    """
    factor = math.exp(max(-50.0, min(50.0, -ZOOM_PER_STEP * steps))) if math.isfinite(steps) else 1.0
    return _keep_finite(replace(camera, distance=_clamp_distance(camera.distance * factor, radius)), camera)


def dolly(camera: ViewCamera, dy: float, radius: float) -> ViewCamera:
    """Drag: down goes away, up goes nearer, in proportion to the distance."""
    return zoom(camera, -dy * DOLLY_PER_PIXEL / ZOOM_PER_STEP, radius)


def drag(camera: ViewCamera, does: str, dx: float, dy: float, height: float, radius: float) -> ViewCamera:
    """One step of a drag of `DRAGS`; see the function that it names."""
    match does:
        case "orbit":
            return orbit(camera, dx, dy)
        case "look":
            return look(camera, dx, dy)
        case "pan":
            return pan(camera, dx, dy, height)
        case "dolly":
            return dolly(camera, dy, radius)
    raise KeyError(does)


def fly(
    camera: ViewCamera,
    right: float,
    up: float,
    ahead: float,
    seconds: float,
    radius: float,
    pace: float = 1.0,
) -> ViewCamera:
    """Move eye and pivot together, at a speed in proportion to the scene.

    Args:
        right, up, ahead: −1, 0 or 1 from the keys; up is the scene's up, ahead is where one looks
        seconds: since the last step; a stall counts as a tenth of a second at most
        radius: of the scene, world units
        pace: 10 with Shift, 0.1 with Alt
    """
    wish = unit((right, up, ahead), (0.0, 0.0, 0.0))
    length = FLY_RADII_PER_SECOND * radius * pace * max(0.0, min(seconds, 0.1))
    picture = axes(camera)
    steps = (
        (length * wish[0], picture.right),
        (length * wish[1], unit(camera.up, (0.0, 1.0, 0.0))),
        (-length * wish[2], picture.back),
    )
    return _keep_finite(replace(camera, pivot=add_scaled(camera.pivot, *steps)), camera)


def pivot_on(camera: ViewCamera, point: Vec3, radius: float) -> ViewCamera:
    """Double click: the eye stays, the view turns to `point`, which becomes the pivot."""
    turned = look_from(camera, eye(camera), point)
    return _keep_finite(replace(turned, distance=_clamp_distance(turned.distance, radius)), camera)


def toggle_fly(camera: ViewCamera) -> ViewCamera:
    """Orbit ↔ fly; the picture does not move."""
    return replace(camera, mode="orbit" if camera.mode == "fly" else "fly")


def _clamp_distance(distance: float, radius: float) -> float:
    return max(CLOSEST * radius, min(WIDEST * radius, distance))


def _wrap_degrees(degrees: float) -> float:
    return (degrees + 180.0) % 360.0 - 180.0 if math.isfinite(degrees) else degrees


def _keep_finite(new: ViewCamera, old: ViewCamera) -> ViewCamera:
    numbers = (*new.pivot, new.distance, new.azimuth, new.elevation)
    fits = all(math.isfinite(v) and abs(v) <= FARTHEST for v in numbers) and new.distance > 0.0
    return new if fits else old


@dataclass(frozen=True)
class DragBinding:
    """A mouse drag on the picture. `mode`: only in this camera mode; empty is both."""

    button: str
    modifier: str
    does: str
    mode: str = ""


@dataclass(frozen=True)
class KeyBinding:
    """A key: modifiers in the order Ctrl, Shift, Alt, then the key's name.

    `repeats` while held; with `tap` it is done when the key is let go soon, as held it does something else.
    """

    chord: str
    action: str
    help: str
    repeats: bool = False
    tap: bool = False


DRAGS = (
    DragBinding("left", "", "orbit"),
    DragBinding("left", "Alt", "orbit"),
    DragBinding("middle", "", "orbit"),
    DragBinding("middle", "Shift", "pan"),
    DragBinding("middle", "Ctrl", "dolly"),
    DragBinding("right", "", "look", mode="fly"),
    DragBinding("right", "", "pan"),
)

FLY_KEYS = {"W": (0, 0, 1), "S": (0, 0, -1), "A": (-1, 0, 0), "D": (1, 0, 0), "Q": (0, -1, 0), "E": (0, 1, 0)}
"""Physical keys (their places on a US keyboard) → right, up, ahead."""

HELD_ORIGINAL = "\\"
TAP_S = 0.25
"""A key that is let go sooner was tapped, not held."""
NUDGES = (("", 0.01), ("Shift+", 0.10), ("Ctrl+", 0.001))

KEYS = (
    *(
        KeyBinding(str(i), f"focus:{i}", "select a layer; with Shift show or hide" if i == 1 else "")
        for i in range(1, 10)
    ),
    *(KeyBinding(f"Shift+{i}", f"toggle:{i}", "") for i in range(1, 10)),
    *(
        KeyBinding(f"{held}{arrow}", f"nudge:{sign * step:g}", help_, repeats=True)
        for held, step in NUDGES
        for arrow, sign, help_ in (
            ("Left", -1, ""),
            ("Right", 1, "strength or gain; Shift coarse, Ctrl fine" if not held else ""),
            ("Down", -1, ""),
            ("Up", 1, ""),
        )
    ),
    KeyBinding("Tab", "next_slider:1", "next slider for the arrow keys"),
    KeyBinding("Shift+Tab", "next_slider:-1", ""),
    KeyBinding("H", "hide", "show or hide the selected layer"),
    KeyBinding("Shift+H", "solo", "solo (Alt+click the eye)"),
    KeyBinding("Alt+H", "show_all", "show all"),
    KeyBinding("Shift+L", "lock", "lock"),
    KeyBinding("G", "fold", "gains and curve; with Alt compact rows"),
    KeyBinding("Enter", "rename", "rename (double-click the name)"),
    KeyBinding("Ctrl+D", "duplicate", "duplicate"),
    KeyBinding("Ctrl+Delete", "remove", "delete"),
    KeyBinding("Alt+Up", "move:-1", ""),
    KeyBinding("Alt+Down", "move:1", "move up or down (drag the name)"),
    KeyBinding("Ctrl+Alt+A", "select_layers", "select all (Ctrl+click, Shift+click)"),
    KeyBinding("Ctrl+G", "group", "group; with Shift ungroup"),
    KeyBinding("Ctrl+Shift+G", "ungroup", ""),
    KeyBinding("Ctrl+C", "copy_values", "copy, paste, reset strength and gains"),
    KeyBinding("Ctrl+V", "paste_values", ""),
    KeyBinding("Ctrl+R", "reset", ""),
    KeyBinding("Ctrl+Shift+R", "reset_all", ""),
    KeyBinding("Ctrl+F", "search", "search layers"),
    KeyBinding("Alt+G", "cards", ""),
    KeyBinding("B", "brush", "paint strength (left drag)"),
    KeyBinding("X", "brush_mode", "brush: erase, smooth, add"),
    KeyBinding("Shift+B", "brush_through", "brush: front surface or all depths"),
    KeyBinding("C", "brush_weights", "brush: tint or all weights as colors"),
    KeyBinding("[", f"brush_radius:{1 / 1.25:g}", "", repeats=True),
    KeyBinding("]", "brush_radius:1.25", "brush radius; with Shift softness", repeats=True),
    KeyBinding("Shift+[", "brush_softness:-0.1", "", repeats=True),
    KeyBinding("Shift+]", "brush_softness:0.1", "", repeats=True),
    KeyBinding("Backspace", "paint_clear", "clear the paint; with Shift fill it"),
    KeyBinding("Shift+Backspace", "paint_fill", ""),
    KeyBinding("Shift+X", "paint_feather", "feather the paint"),
    KeyBinding("R", "select_tool:box", "box, lasso, polygon, brush"),
    KeyBinding("L", "select_tool:lasso", ""),
    KeyBinding("P", "select_tool:polygon", ""),
    KeyBinding("U", "select_tool:brush", ""),
    KeyBinding("Shift+R", "select_tool:sphere", ""),
    KeyBinding("J", "select_tool:flood", "sphere, connected and alike, alike"),
    KeyBinding("I", "select_tool:color", ""),
    KeyBinding("N", "select_through", "front surface or all depths"),
    KeyBinding("Ctrl+A", "select_all", "all; with Shift none"),
    KeyBinding("Ctrl+Shift+A", "select_none", ""),
    KeyBinding("Ctrl+I", "invert", "invert, or the paint with the brush"),
    KeyBinding("Ctrl+[", "select_shrink", "", repeats=True),
    KeyBinding("Ctrl+]", "select_grow", "shrink, grow", repeats=True),
    KeyBinding("Ctrl+H", "hide_selected", "hide; with Shift isolate"),
    KeyBinding("Ctrl+Shift+H", "isolate", ""),
    KeyBinding("M", "blend", "next blend rule"),
    KeyBinding("O", "overshoot", "overshoot to 1.2"),
    KeyBinding("Escape", "unfocus", "close this list; leave the tool; deselect"),
    KeyBinding("Ctrl+Z", "undo", "undo", repeats=True),
    KeyBinding("Ctrl+Shift+Z", "redo", "redo", repeats=True),
    KeyBinding("Ctrl+Y", "redo", "", repeats=True),
    KeyBinding("V", "fly", "orbit or fly mode"),
    KeyBinding("F", "frame", "frame the selection, layer or scene"),
    KeyBinding("Num.", "frame", ""),
    KeyBinding("Shift+F", "home", "reset the view (numpad 0)"),
    KeyBinding("Num0", "home", ""),
    KeyBinding("Num1", "look:front", "front, right, top; Ctrl opposite"),
    KeyBinding("Num3", "look:right", ""),
    KeyBinding("Num7", "look:top", ""),
    KeyBinding("Ctrl+Num1", "look:back", ""),
    KeyBinding("Ctrl+Num3", "look:left", ""),
    KeyBinding("Ctrl+Num7", "look:bottom", ""),
    KeyBinding("Shift+G", "grid", "grid on the ground"),
    KeyBinding(HELD_ORIGINAL, "before", "original: tap, or hold", tap=True),
    KeyBinding("Y", "beside", "side by side; with Shift split view"),
    KeyBinding("Shift+Y", "split", ""),
    KeyBinding("D", "difference", "difference (a tap; held it flies)", tap=True),
    KeyBinding("Alt+Y", "against", "compare with the recording"),
    KeyBinding("Space", "play", "play or pause"),
    KeyBinding("K", "key", "insert a keyframe"),
    KeyBinding("Delete", "drop_key", "delete the keyframe"),
    KeyBinding(",", "step:-1", "", repeats=True),
    KeyBinding(".", "step:1", "previous or next frame", repeats=True),
    KeyBinding("Shift+,", "jump:-1", ""),
    KeyBinding("Shift+.", "jump:1", "previous or next keyframe"),
    KeyBinding("Shift+K", "easing", "interpolation: smooth, linear, hold"),
    KeyBinding("Alt+K", "ping_pong", "ping-pong"),
    KeyBinding("Ctrl+K", "timeline_file", "save the timeline as a file"),
    KeyBinding("T", "timeline", "show or hide the timeline"),
    KeyBinding("F1", "help", "this list"),
    KeyBinding("F2", "picture", "save the picture as PNG"),
    KeyBinding("Ctrl+F2", "take_view", "take this view without edits, to change it"),
    KeyBinding("Shift+F2", "window_picture", "save the whole window as PNG"),
    KeyBinding("F3", "snapshot", "add a snapshot; with Shift compare two"),
    KeyBinding("Shift+F3", "compare_snapshots", ""),
    KeyBinding("F4", "camera", "save this view as a camera"),
    KeyBinding("Ctrl+N", "new_edit", "new edit"),
    KeyBinding("Ctrl+S", "save", "save the session"),
    KeyBinding("Ctrl+Shift+S", "save_as", "save the session as"),
    KeyBinding("Ctrl+O", "open", "open a session, scene or edit"),
    KeyBinding("Ctrl+E", "export", "export the edited scene as .ply"),
    KeyBinding("Ctrl+P", "render_picture", "render a picture"),
    KeyBinding("Ctrl+Shift+P", "render_film", "render a film"),
    KeyBinding("F10", "overlay", "show timings"),
    KeyBinding("Shift+F10", "dynamic_resolution", "dynamic resolution: auto, on, off"),
    KeyBinding("F11", "full_screen", "full screen"),
    KeyBinding("F12", "panel", "show or hide the panel"),
    KeyBinding("Ctrl+Q", "quit", "quit"),
)


OPENS_TEXT = (
    "rename",
    "search",
    "new_edit",
    "save",
    "save_as",
    "open",
    "export",
    "render_picture",
    "render_film",
)
"""Actions after which one types."""


def drag_for(button: str, modifier: str, mode: str) -> str | None:
    """What a drag does, or None where nothing is bound. `modifier`: "", "Shift", "Ctrl" or "Alt"."""
    for drag in DRAGS:
        if drag.button == button and drag.modifier == modifier and drag.mode in ("", mode):
            return drag.does
    return None
