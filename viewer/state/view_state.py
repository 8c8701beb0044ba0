"""What the window shows, as frozen data: panel, keys, scripts and files change it, the engine draws it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from progdf.compose.reference import Gains
from viewer.camera.up_axis import Vec3
from viewer.camera.view_camera import ViewCamera


@dataclass(frozen=True)
class LayerState:
    """One layer row: which .gdf (by its place in the engine's list), and how much of it.

    Args:
        gdf: index into the engine's edits
        name: no two layers of a stack share one
        strength: 0..1, up to `stack.OVERSHOOT` where the view allows it
        enabled: the eye; `solo` wins over it
        gains: how much of each kind of change comes through, 0..1
        solo: only soloed layers are shown while there are any
        locked: strength, gains and paint stay as they are
        paint: a weight per member, as `paint.encode` writes it; empty is 1 everywhere
    """

    gdf: int
    name: str
    strength: float = 0.0
    enabled: bool = True
    gains: Gains = Gains()
    solo: bool = False
    locked: bool = False
    paint: str = ""


@dataclass(frozen=True)
class Brush:
    """What paints the strength of the focused layer.

    Args:
        active: whether the left mouse button paints
        radius: pixels at 1×
        softness: the part of the radius over which its touch fades, 0..1
        mode: of `paint.MODES`
        through: also behind the front surface
        weights: the members of the focused layer show their weights as colors meanwhile
    """

    active: bool = False
    radius: float = 40.0
    softness: float = 0.5
    mode: str = "erase"
    through: bool = False
    weights: bool = True


@dataclass(frozen=True)
class Comparison:
    """What the edited picture is set against, and how (see comparison.py).

    Args:
        mode: "off", "split" or "difference"
        divider: where the edited side of a split begins, share of the picture's width
        amplify: what a difference is multiplied by, 1 to 64
        against: "original", or "recorded": the same strengths as training recorded them, where it did
    """

    mode: str = "off"
    divider: float = 0.5
    amplify: float = 4.0
    against: str = "original"


@dataclass(frozen=True)
class Keyframe:
    """What the timeline shows at one frame.

    Args:
        frame: from 0
        strengths: `LayerState.gdf` and its strength
        camera: None where the film leaves the camera alone
        easing: how it goes on from here, of `timeline.EASINGS`
    """

    frame: int
    strengths: tuple[tuple[int, float], ...] = ()
    camera: ViewCamera | None = None
    easing: str = "smooth"


@dataclass(frozen=True)
class Timeline:
    """Keys over frames (see timeline.py).

    Args:
        keys: by rising frames, no two at the same
        length: the last frame; frame 0 is the first
        fps: frames per second
        ping_pong: back again after the last frame
    """

    keys: tuple[Keyframe, ...] = ()
    length: int = 72
    fps: int = 24
    ping_pong: bool = False


@dataclass(frozen=True)
class ViewState:
    """Everything that decides the picture, and what of the panel is open.

    Args:
        overshoot: sliders go on to `stack.OVERSHOOT`, which extrapolates
        unfolded: which edits (`LayerState.gdf`) show their gains and curve
        brush: what paints
        dynamic_resolution: of `RESOLUTION_MODES`: when the window draws coarsely while something moves
    """

    camera: ViewCamera = ViewCamera()
    layers: tuple[LayerState, ...] = ()
    blend: str = "normalized"
    background: Vec3 = (1.0, 1.0, 1.0)
    overlay: bool = False
    panel: bool = True
    compare: Comparison = Comparison()
    overshoot: bool = False
    unfolded: tuple[int, ...] = ()
    brush: Brush = Brush()
    timeline: Timeline = Timeline()
    dynamic_resolution: str = "auto"


RESOLUTION_MODES = ("auto", "on", "off")
"""`ViewState.dynamic_resolution`: where it pays, always, never."""


def next_resolution_mode(view: ViewState) -> ViewState:
    """The state with the next of `RESOLUTION_MODES`."""
    following = RESOLUTION_MODES.index(view.dynamic_resolution) + 1
    return replace(view, dynamic_resolution=RESOLUTION_MODES[following % len(RESOLUTION_MODES)])
