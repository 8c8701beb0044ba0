"""State of the view as frozen data. Panel, keys, scripts and files change it; the engine draws it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, TypeVar

from msgspec import Meta

from progdf.compose.layers import BLENDS, DEFAULT_BLEND, Gains
from progdf.gdf.placed import Placement
from progdf.io.json_values import one_of
from progdf.painting.strokes import MAX_SIDE_PX
from viewer.camera.view_camera import SHAPES, ViewCamera
from viewer.camera.views import EASINGS

from .selection import SelectionState

Value = TypeVar("Value")

OVERSHOOT = 1.2
"""Largest strength with overshoot on. Strengths above 1 are extrapolated, not learned."""
BRUSH_MODES = ("add", "erase", "smooth")
SMALLEST_PX = 4.0  # smallest radius of a brush, pixels at 1×
LARGEST_PX = 400.0  # largest radius of a brush, pixels at 1×
PAINT_TOOLS = ("color", "clone")
MAX_PAINTED = 16
"""Largest number of views that can be painted before the paint becomes a layer."""
SELECT_TOOLS = ("box", "lasso", "polygon", "brush", "scribble", "sphere", "flood", "color")
SELECT_MODES = ("new", "add", "subtract", "intersect")
COMPARE_MODES = ("off", "beside", "split", "difference")
AGAINST = ("original", "snapshots", "photograph")
MAX_AMPLIFIED = 64.0  # largest factor of a difference view
MAX_SCENES = 32
"""Largest number of scenes in a view."""
MAX_FRAME = 9999  # largest last frame of a timeline
MAX_FPS = 120  # largest frame rate of a timeline, frames per second
CARD_MODES = ("auto", "full", "compact")
"""Values of `ViewState.cards`: compact rows if full cards do not fit, never, always."""
FRAMES = ("", *SHAPES)
"""Values of `ViewState.safe_frame`: none, or an aspect ratio of films."""
VIEW_MODES = ("splats", "centers", "rings", "depth", "normals", "opacity", "contribution")
"""Values of `ViewState.mode`, see `viewer.render.view_modes`."""
RESOLUTION_MODES = ("auto", "on", "off")
"""Values of `ViewState.dynamic_resolution`: if it saves time, always, never."""

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Unit = Annotated[float, Meta(gt=0.0, le=1e12)]
Strength = Annotated[float, Meta(ge=0.0, le=OVERSHOOT)]
Blend = Annotated[str, one_of(BLENDS)]
LayerBlend = Annotated[str, one_of(("", *BLENDS))]
Frame = Annotated[int, Meta(ge=0)]
Length = Annotated[int, Meta(ge=1, le=MAX_FRAME)]
Fps = Annotated[int, Meta(ge=1, le=MAX_FPS)]
Side = Annotated[int, Meta(ge=1, le=MAX_SIDE_PX)]
Edge = Annotated[int, Meta(ge=0, le=MAX_SIDE_PX)]
Easing = Annotated[str, one_of(EASINGS)]


@dataclass(frozen=True)
class LayerState:
    """Layer: an edit, given by its index in the engine's list, and its strength and options."""

    gdf: int  # index into the engine's edits
    name: str  # unique in the stack
    strength: Strength = 0.0  # 0 to 1, or to `OVERSHOOT` with overshoot on
    enabled: bool = True  # visibility; `solo` takes precedence
    gains: Gains = Gains()  # share of each kind of change, 0 to 1
    solo: bool = False  # if any layer is soloed, only soloed layers are visible
    locked: bool = False  # protects strength, gains and paint
    paint: str = ""  # weight per member, from `layer_paint.encode`; empty is 1 everywhere
    group: str = ""  # name of its group, "" for none; the layers of a group are adjacent
    blend: LayerBlend = ""  # its own blend rule, "" for that of the stack


@dataclass(frozen=True)
class SceneState:
    """Scene of a view with several scenes."""

    scene: Annotated[int, Meta(ge=0)]  # index into the document's scenes
    name: str  # unique in the view
    visible: bool = True
    placement: Placement = Placement()


@dataclass(frozen=True)
class LayerGroup:
    """Group of layers with a common visibility and strength."""

    name: str  # unique among the groups
    enabled: bool = True  # visibility; soloed layers are visible regardless
    strength: Share = 1.0  # factor on the strengths of its layers


@dataclass(frozen=True)
class Brush:
    """Brush that paints the strength of the focused layer."""

    active: bool = False  # whether the left mouse button paints
    radius: Annotated[float, Meta(ge=SMALLEST_PX, le=LARGEST_PX)] = 40.0  # pixels at 1×
    softness: Share = 0.5  # share of the radius over which its influence fades, 0 to 1
    mode: Annotated[str, one_of(BRUSH_MODES)] = "erase"  # one of `BRUSH_MODES`
    through: bool = False  # also affects members behind the front surface
    # color the members of the focused layer by weight; if False, a faint tint marks weights below 1
    weights: bool = False
    flow: Share = 1.0  # share of the way to its target weight that a stroke covers, 0 to 1
    value: Share = 1.0  # target weight of "add", 0 to 1


@dataclass(frozen=True)
class ColorBrush:
    """Brush that paints colors on the visible surface, and the clone stamp."""

    tool: Annotated[str, one_of(("", *PAINT_TOOLS))] = ""  # one of `PAINT_TOOLS`, "" for none
    erases: bool = False  # strokes erase paint
    radius: Annotated[float, Meta(ge=SMALLEST_PX, le=LARGEST_PX)] = 20.0  # pixels at 1×
    hardness: Share = 0.8  # share of the radius with full influence, 0 to 1
    flow: Share = 1.0  # influence of one stroke, 0 to 1
    color: tuple[Share, Share, Share] = (0.85, 0.18, 0.18)  # sRGB, 0 to 1


@dataclass(frozen=True)
class PaintedPicture:
    """Paint on the scene in one view, as straight RGBA that is packed by `progdf.painting.strokes.pack`."""

    camera: ViewCamera
    size: tuple[Side, Side]  # width and height, pixels
    box: tuple[Edge, Edge, Edge, Edge]  # packed pixels: left, top, right and bottom
    pixels: bytes


@dataclass(frozen=True)
class SelectTool:
    """Tool that selects Gaussians in the picture."""

    tool: Annotated[str, one_of(("", *SELECT_TOOLS))] = ""  # one of `SELECT_TOOLS`, "" for none
    mode: Annotated[str, one_of(SELECT_MODES)] = "new"  # one of `SELECT_MODES`; modifier keys override it
    through: bool = False  # also selects behind the front surface
    radius: Annotated[float, Meta(ge=SMALLEST_PX, le=LARGEST_PX)] = 30.0  # brush radius, pixels at 1×
    tolerance: Share = 0.08  # largest OKLab distance from the clicked color


@dataclass(frozen=True)
class Comparison:
    """Comparison of the edited picture with another one."""

    mode: Annotated[str, one_of(COMPARE_MODES)] = "off"  # one of `COMPARE_MODES`
    divider: Share = 0.5  # start of the edited side of a split, share of the picture's width
    # factor of a difference view, 1 to `MAX_AMPLIFIED`
    amplify: Annotated[float, Meta(ge=1.0, le=MAX_AMPLIFIED)] = 4.0
    # "original"; "snapshots": A of `ViewState.pair` against B, independent of the sliders; or "photograph" of
    # the training camera that the view looks through
    against: Annotated[str, one_of(AGAINST)] = "original"


@dataclass(frozen=True)
class SnapshotPair:
    """Names of the two compared snapshots, "" for the last two (see snapshots.py)."""

    a: str = ""  # left side of the comparison
    b: str = ""  # right side


@dataclass(frozen=True)
class Keyframe:
    """Camera and strengths at one frame of the timeline."""

    frame: Frame  # from 0
    strengths: tuple[tuple[int, Strength], ...] = ()  # `LayerState.gdf` and its strength
    camera: ViewCamera | None = None  # None for no camera key
    easing: Easing = "smooth"  # interpolation to the next key, one of `EASINGS`


@dataclass(frozen=True)
class Timeline:
    """Keys over frames (see timeline.py)."""

    keys: tuple[Keyframe, ...] = ()  # by ascending frame, at most one per row and frame
    length: Length = 72  # the last frame; frame 0 is the first
    fps: Fps = 24  # frames per second
    ping_pong: bool = False  # play backwards after the last frame


@dataclass(frozen=True)
class ViewState:
    """All values that determine the picture, and the open parts of the panel."""

    camera: ViewCamera = ViewCamera()
    layers: tuple[LayerState, ...] = ()
    blend: Blend = DEFAULT_BLEND  # rule of all layers without their own
    background: tuple[Share, Share, Share] = (1.0, 1.0, 1.0)
    panel: bool = True  # show the panel and all overlays
    compare: Comparison = Comparison()
    overshoot: bool = False  # extend sliders to `OVERSHOOT`, which extrapolates
    unfolded: tuple[int, ...] = ()  # edits (`LayerState.gdf`) whose gains are visible
    brush: Brush = Brush()
    color_brush: ColorBrush = ColorBrush()
    # paint that is not a layer yet, a picture per view; later ones cover earlier ones
    painted: Annotated[tuple[PaintedPicture, ...], Meta(max_length=MAX_PAINTED)] = ()
    timeline: Timeline = Timeline()
    # one of `RESOLUTION_MODES`: when the window draws motion at a lower resolution
    dynamic_resolution: Annotated[str, one_of(RESOLUTION_MODES)] = "auto"
    selection: SelectionState = SelectionState()  # selected and hidden Gaussians, regions
    select: SelectTool = SelectTool()
    pair: SnapshotPair = SnapshotPair()  # the compared snapshots
    grid: bool = False  # draw a ground grid in the window, never in pictures and films
    axes: bool = True  # draw the world axes in the window
    safe_frame: Annotated[str, one_of(FRAMES)] = ""  # one of `FRAMES`: outline of a film's frame
    groups: tuple[LayerGroup, ...] = ()  # layer groups, in no particular order
    collapsed: tuple[str, ...] = ()  # names of the groups that are collapsed in the panel
    cards: Annotated[str, one_of(CARD_MODES)] = "auto"  # one of `CARD_MODES`
    mode: Annotated[str, one_of(VIEW_MODES)] = "splats"  # one of `VIEW_MODES`; in the window alone
    # true length of a world unit, by which the window shows and reads lengths; files keep world units
    unit: Unit = 1.0
    # scenes of the view, in the order of the panel's rows; empty: the document's only scene
    scenes: Annotated[tuple[SceneState, ...], Meta(max_length=MAX_SCENES)] = ()

    @property
    def has_tool(self) -> bool:
        """True if a tool for selecting or painting is active."""
        return bool(self.select.tool or self.brush.active or self.color_brush.tool)


def on_another_scene(view: ViewState, camera: ViewCamera) -> ViewState:
    """Return a view of another scene from `camera`, with the window's settings of `view`.

    All other attributes belong to the scene and are reset, including attributes added to `ViewState` later.
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
    """Return the value after `value`, cyclically."""
    return values[(values.index(value) + 1) % len(values)]
