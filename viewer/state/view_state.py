"""What the window shows, as frozen data: panel, keys, scripts and files change it, the engine draws it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from msgspec import Meta

from progdf.compose.layers import BLENDS, Gains
from progdf.io.json_values import one_of
from viewer.camera.tween import EASINGS
from viewer.camera.view_camera import ViewCamera

from .selection import SelectionState

OVERSHOOT = 1.2
"""How far a slider goes where overshoot is on: beyond 1 the edit is extrapolated, not learned."""
BRUSH_MODES = ("add", "erase", "smooth")
SMALLEST_PX, LARGEST_PX = 4.0, 400.0
SELECT_TOOLS = ("box", "lasso", "polygon", "brush", "sphere", "flood", "color")
SELECT_MODES = ("new", "add", "subtract", "intersect")
COMPARE_MODES = ("off", "beside", "split", "difference")
AGAINST = ("original", "recorded", "snapshots")
MOST_AMPLIFIED = 64.0
LONGEST, FASTEST = 9999, 120  # frames, frames per second
CARD_MODES = ("auto", "full", "compact")
"""`ViewState.cards`: rows of one line where cards would not fit, never, always."""
RESOLUTION_MODES = ("auto", "on", "off")
"""`ViewState.dynamic_resolution`: where it pays, always, never."""

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Strength = Annotated[float, Meta(ge=0.0, le=OVERSHOOT)]
Blend = Annotated[str, one_of(BLENDS)]
Frame = Annotated[int, Meta(ge=0)]
Length = Annotated[int, Meta(ge=1, le=LONGEST)]
Fps = Annotated[int, Meta(ge=1, le=FASTEST)]
Easing = Annotated[str, one_of(EASINGS)]


@dataclass(frozen=True)
class LayerState:
    """One layer row: which .gdf (by its place in the engine's list), and how much of it.

    Args:
        gdf: index into the engine's edits
        name: no two layers of a stack share one
        strength: 0..1, up to `OVERSHOOT` where the view allows it
        enabled: the eye; `solo` wins over it
        gains: how much of each kind of change comes through, 0..1
        solo: only soloed layers are shown while there are any
        locked: strength, gains and paint stay as they are
        paint: a weight per member, as `paint.encode` writes it; empty is 1 everywhere
        group: the name of the group it is in, "" for none; those of a group lie next to each other
    """

    gdf: int
    name: str
    strength: Strength = 0.0
    enabled: bool = True
    gains: Gains = Gains()
    solo: bool = False
    locked: bool = False
    paint: str = ""
    group: str = ""


@dataclass(frozen=True)
class LayerGroup:
    """Layers that are switched and dimmed together.

    Args:
        name: no two groups share one
        enabled: the eye; a soloed layer is shown all the same
        strength: what the strengths of its layers are multiplied by
    """

    name: str
    enabled: bool = True
    strength: Share = 1.0


@dataclass(frozen=True)
class Brush:
    """What paints the strength of the focused layer.

    Args:
        active: whether the left mouse button paints
        radius: pixels at 1×
        softness: the part of the radius over which its touch fades, 0..1
        mode: of `BRUSH_MODES`
        through: also behind the front surface
        weights: the members of the focused layer show their weights as colors meanwhile; else only a thin
            tint lies over those that have less than all of the edit
        flow: how far one stroke goes towards what it gives, 0..1
        value: the weight that "add" gives, 0..1
    """

    active: bool = False
    radius: Annotated[float, Meta(ge=SMALLEST_PX, le=LARGEST_PX)] = 40.0
    softness: Share = 0.5
    mode: Annotated[str, one_of(BRUSH_MODES)] = "erase"
    through: bool = False
    weights: bool = False
    flow: Share = 1.0
    value: Share = 1.0


@dataclass(frozen=True)
class SelectTool:
    """What selects in the picture.

    Args:
        tool: of `SELECT_TOOLS`, "" for none
        mode: of `SELECT_MODES`; modifiers go before it
        through: also what lies behind the front surface
        radius: of the brush, pixels at 1×
        tolerance: how far colors may be from the one that was clicked, OKLab
    """

    tool: Annotated[str, one_of(("", *SELECT_TOOLS))] = ""
    mode: Annotated[str, one_of(SELECT_MODES)] = "new"
    through: bool = False
    radius: Annotated[float, Meta(ge=SMALLEST_PX, le=LARGEST_PX)] = 30.0
    tolerance: Share = 0.08


@dataclass(frozen=True)
class Comparison:
    """What the edited picture is set against, and how (see comparison.py).

    Args:
        mode: of `COMPARE_MODES`
        divider: where the edited side of a split begins, share of the picture's width
        amplify: what a difference is multiplied by, 1 to 64
        against: "original", or "recorded": the same strengths as training recorded them, where it did; or
            "snapshots": A of `ViewState.pair` against its B, whatever the sliders say
    """

    mode: Annotated[str, one_of(COMPARE_MODES)] = "off"
    divider: Share = 0.5
    amplify: Annotated[float, Meta(ge=1.0, le=MOST_AMPLIFIED)] = 4.0
    against: Annotated[str, one_of(AGAINST)] = "original"


@dataclass(frozen=True)
class SnapshotPair:
    """Two snapshots by their names, "" for the last two there are (see snapshots.py).

    Args:
        a, b: what is compared, and what lies at the ends of the slider between them
        share: where that slider was left, 0 at A
    """

    a: str = ""
    b: str = ""
    share: Share = 0.0


@dataclass(frozen=True)
class Keyframe:
    """What the timeline shows at one frame.

    Args:
        frame: from 0
        strengths: `LayerState.gdf` and its strength
        camera: None where the film leaves the camera alone
        easing: how it goes on from here, of `EASINGS`
    """

    frame: Frame
    strengths: tuple[tuple[int, Strength], ...] = ()
    camera: ViewCamera | None = None
    easing: Easing = "smooth"


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
    length: Length = 72
    fps: Fps = 24
    ping_pong: bool = False


@dataclass(frozen=True)
class ViewState:
    """Everything that decides the picture, and what of the panel is open.

    Args:
        overshoot: sliders go on to `OVERSHOOT`, which extrapolates
        unfolded: which edits (`LayerState.gdf`) show their gains and curve
        brush: what paints
        dynamic_resolution: of `RESOLUTION_MODES`: when the window draws coarsely while something moves
        selection: what is selected and hidden, and the regions
        select: what selects
        grid: the window draws a grid on the ground; pictures and films never have it
        axes: the window shows where the axes of the world point
        pair: the snapshots that are compared and blended
        groups: of layers, in no order
        collapsed: names of the groups whose layers the panel does not list
        cards: of `CARD_MODES`
    """

    camera: ViewCamera = ViewCamera()
    layers: tuple[LayerState, ...] = ()
    blend: Blend = "normalized"
    background: tuple[Share, Share, Share] = (1.0, 1.0, 1.0)
    overlay: bool = False
    panel: bool = True
    compare: Comparison = Comparison()
    overshoot: bool = False
    unfolded: tuple[int, ...] = ()
    brush: Brush = Brush()
    timeline: Timeline = Timeline()
    dynamic_resolution: Annotated[str, one_of(RESOLUTION_MODES)] = "auto"
    selection: SelectionState = SelectionState()
    select: SelectTool = SelectTool()
    pair: SnapshotPair = SnapshotPair()
    grid: bool = False
    axes: bool = True
    groups: tuple[LayerGroup, ...] = ()
    collapsed: tuple[str, ...] = ()
    cards: Annotated[str, one_of(CARD_MODES)] = "auto"


def on_another_scene(view: ViewState, camera: ViewCamera) -> ViewState:
    """The window's own settings, with another scene seen by `camera`.

    All else belongs to the scene and goes with it, also what is added to `ViewState` some day.
    """
    return ViewState(
        camera,
        background=view.background,
        overlay=view.overlay,
        panel=view.panel,
        dynamic_resolution=view.dynamic_resolution,
        grid=view.grid,
        axes=view.axes,
        cards=view.cards,
    )


def next_resolution_mode(view: ViewState) -> ViewState:
    """The state with the next of `RESOLUTION_MODES`."""
    following = RESOLUTION_MODES.index(view.dynamic_resolution) + 1
    return replace(view, dynamic_resolution=RESOLUTION_MODES[following % len(RESOLUTION_MODES)])
