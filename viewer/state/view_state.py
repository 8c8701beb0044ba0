"""What the window shows, as frozen data: panel, keys, scripts and files change it, the engine draws it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, TypeVar

from msgspec import Meta

from progdf.compose.layers import BLENDS, Gains
from progdf.io.json_values import one_of
from viewer.camera.view_camera import SHAPES, ViewCamera
from viewer.camera.views import EASINGS

from .selection import SelectionState

Value = TypeVar("Value")

OVERSHOOT = 1.2
"""How far a slider goes where overshoot is on: beyond 1 the edit is extrapolated, not learned."""
BRUSH_MODES = ("add", "erase", "smooth")
SMALLEST_PX = 4.0
LARGEST_PX = 400.0
SELECT_TOOLS = ("box", "lasso", "polygon", "brush", "scribble", "sphere", "flood", "color")
SELECT_MODES = ("new", "add", "subtract", "intersect")
COMPARE_MODES = ("off", "beside", "split", "difference")
AGAINST = ("original", "snapshots")
MAX_AMPLIFIED = 64.0
# frames, frames per second
LONGEST = 9999
FASTEST = 120
CARD_MODES = ("auto", "full", "compact")
"""`ViewState.cards`: rows of one line where cards would not fit, never, always."""
FRAMES = ("", *SHAPES)
"""`ViewState.safe_frame`: none, or a shape of films."""
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
    """One layer row: which .gdf (by its place in the engine's list), and how much of it."""

    gdf: int  # index into the engine's edits
    name: str  # no two layers of a stack share one
    strength: Strength = 0.0  # 0..1, up to `OVERSHOOT` where the view allows it
    enabled: bool = True  # the eye; `solo` wins over it
    gains: Gains = Gains()  # how much of each kind of change comes through, 0..1
    solo: bool = False  # only soloed layers are shown while there are any
    locked: bool = False  # strength, gains and paint stay as they are
    paint: str = ""  # a weight per member, as `paint.encode` writes it; empty is 1 everywhere
    group: str = ""  # the name of the group it is in, "" for none; those of a group lie next to each other


@dataclass(frozen=True)
class LayerGroup:
    """Layers that are switched and dimmed together."""

    name: str  # no two groups share one
    enabled: bool = True  # the eye; a soloed layer is shown all the same
    strength: Share = 1.0  # what the strengths of its layers are multiplied by


@dataclass(frozen=True)
class Brush:
    """What paints the strength of the focused layer."""

    active: bool = False  # whether the left mouse button paints
    radius: Annotated[float, Meta(ge=SMALLEST_PX, le=LARGEST_PX)] = 40.0  # pixels at 1×
    softness: Share = 0.5  # the part of the radius over which its touch fades, 0..1
    mode: Annotated[str, one_of(BRUSH_MODES)] = "erase"  # of `BRUSH_MODES`
    through: bool = False  # also behind the front surface
    # the members of the focused layer show their weights as colors meanwhile; else only a thin tint lies over
    # those that have less than all of the edit
    weights: bool = False
    flow: Share = 1.0  # how far one stroke goes towards what it gives, 0..1
    value: Share = 1.0  # the weight that "add" gives, 0..1


@dataclass(frozen=True)
class SelectTool:
    """What selects in the picture."""

    tool: Annotated[str, one_of(("", *SELECT_TOOLS))] = ""  # of `SELECT_TOOLS`, "" for none
    mode: Annotated[str, one_of(SELECT_MODES)] = "new"  # of `SELECT_MODES`; modifiers go before it
    through: bool = False  # also what lies behind the front surface
    radius: Annotated[float, Meta(ge=SMALLEST_PX, le=LARGEST_PX)] = 30.0  # of the brush, pixels at 1×
    tolerance: Share = 0.08  # how far colors may be from the one that was clicked, OKLab


@dataclass(frozen=True)
class Comparison:
    """What the edited picture is set against, and how."""

    mode: Annotated[str, one_of(COMPARE_MODES)] = "off"  # of `COMPARE_MODES`
    divider: Share = 0.5  # where the edited side of a split begins, share of the picture's width
    # what a difference is multiplied by, 1 to 64
    amplify: Annotated[float, Meta(ge=1.0, le=MAX_AMPLIFIED)] = 4.0
    # "original", or "snapshots": A of `ViewState.pair` against its B, whatever the sliders say
    against: Annotated[str, one_of(AGAINST)] = "original"


@dataclass(frozen=True)
class SnapshotPair:
    """Two snapshots by their names, "" for the last two there are (see snapshots.py)."""

    a: str = ""  # left in the comparison
    b: str = ""  # right


@dataclass(frozen=True)
class Keyframe:
    """What the timeline shows at one frame."""

    frame: Frame  # from 0
    strengths: tuple[tuple[int, Strength], ...] = ()  # `LayerState.gdf` and its strength
    camera: ViewCamera | None = None  # None where the film leaves the camera alone
    easing: Easing = "smooth"  # how it goes on from here, of `EASINGS`


@dataclass(frozen=True)
class Timeline:
    """Keys over frames (see timeline.py)."""

    keys: tuple[Keyframe, ...] = ()  # by rising frames, no two at the same
    length: Length = 72  # the last frame; frame 0 is the first
    fps: Fps = 24  # frames per second
    ping_pong: bool = False  # back again after the last frame


@dataclass(frozen=True)
class ViewState:
    """Everything that decides the picture, and what of the panel is open."""

    camera: ViewCamera = ViewCamera()
    layers: tuple[LayerState, ...] = ()
    blend: Blend = "adjust"
    background: tuple[Share, Share, Share] = (1.0, 1.0, 1.0)
    panel: bool = True
    compare: Comparison = Comparison()
    overshoot: bool = False  # sliders go on to `OVERSHOOT`, which extrapolates
    unfolded: tuple[int, ...] = ()  # which edits (`LayerState.gdf`) show their gains
    brush: Brush = Brush()  # what paints
    timeline: Timeline = Timeline()
    # of `RESOLUTION_MODES`: when the window draws coarsely while something moves
    dynamic_resolution: Annotated[str, one_of(RESOLUTION_MODES)] = "auto"
    selection: SelectionState = SelectionState()  # what is selected and hidden, and the regions
    select: SelectTool = SelectTool()  # what selects
    pair: SnapshotPair = SnapshotPair()  # the snapshots that are compared
    grid: bool = False  # the window draws a grid on the ground; pictures and films never have it
    axes: bool = True  # the window shows where the axes of the world point
    safe_frame: Annotated[str, one_of(FRAMES)] = ""  # of `FRAMES`: what a film of this shape will show
    groups: tuple[LayerGroup, ...] = ()  # of layers, in no order
    collapsed: tuple[str, ...] = ()  # names of the groups whose layers the panel does not list
    cards: Annotated[str, one_of(CARD_MODES)] = "auto"  # of `CARD_MODES`


def on_another_scene(view: ViewState, camera: ViewCamera) -> ViewState:
    """The window's own settings, with another scene seen by `camera`.

    All else belongs to the scene and goes with it, also what is added to `ViewState` some day.
    """
    return ViewState(
        camera,
        background=view.background,
        panel=view.panel,
        dynamic_resolution=view.dynamic_resolution,
        grid=view.grid,
        axes=view.axes,
        safe_frame=view.safe_frame,
        cards=view.cards,
    )


def following(values: Sequence[Value], value: Value) -> Value:
    """The next of some values, the first after the last."""
    return values[(values.index(value) + 1) % len(values)]
