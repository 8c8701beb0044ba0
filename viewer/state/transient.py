"""Transient state: overlays, pointer with its tool, recent files. It is neither undone nor saved."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.painting.projection import ViewSurface
from progdf.painting.strokes import ColorStroke
from progdf.scene.scribbles import Rows
from progdf.scene.selection import Centers, Mask, Surface
from progdf.system.equality import equal_fields
from viewer.camera.decal_warp import DecalFrame, DecalMesh
from viewer.camera.photograph import Photograph
from viewer.camera.view_camera import Vec3, ViewCamera

from .paint import Stroke
from .selection import EMPTY_MASK
from .view_state import Brush, ColorBrush, LayerState, PaintedPicture, SelectTool


@dataclass(frozen=True)
class Cover:
    """Picture drawn over the view while the camera stays where the picture was rendered."""

    texture: int  # GL name
    camera: ViewCamera  # the picture's camera
    size: tuple[int, int]  # size of the view, pixels
    name: str = ""  # text of the banner above the picture


class PreviewState(NamedTuple):
    """State of the preview in the form of a new edit."""

    text: str = ""  # progress such as "drawing", or the reason of a failure
    failed: bool = False  # whether `text` is that reason
    busy: bool = False  # whether a model is generating
    painted: bool = False  # whether the picture of a prompt is available
    models: tuple[str, ...] = ()  # models installed on this machine
    sheet: int = 0  # GL name of the texture with the style previews of this view, see `SHEET_PX`
    styles: frozenset[int] = frozenset()  # styles available in it
    near: str = ""  # expected difference of the trained edit: close, roughly or far; "" if not known


class GradeScope(NamedTuple):
    """Histogram of the form's region under its grade."""

    bins: tuple[tuple[float, ...], ...] = ()  # luma, red, green and blue, dark to bright, 0 to 1
    white: float = 0.0  # share of the region that is clipped to white, 0 to 1
    black: float = 0.0  # share that is clipped to black
    note: str = ""  # reason why there are no bins, "" while they are measured


class LookShelf(NamedTuple):
    """Looks of the form, and their thumbnails."""

    looks: tuple[tuple[str, str], ...] = ()  # name and editor of each, see `user_files.read_looks`
    sheet: int = 0  # GL name of the texture with their thumbnails, 0 for none


Transform = Literal["move", "rotate", "scale"]


@dataclass(frozen=True)
class TypedTransform:
    """Transform that a key began. A typed number or the mouse gives its value until a click or Enter."""

    __eq__ = equal_fields

    does: Transform
    start: NDArray[np.float64] = field(compare=False)  # matrix of the handles before it. [4,4]
    axes: str = ""  # world axes, such as "X", or "YZ" for a plane; "" for all, or for the view's axis
    text: str = ""  # typed numbers, one per axis, separated by tabs; "" while the mouse gives the value
    mouse: tuple[float, float] | None = None  # where the mouse was at the start, window pixels


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """Geometry of the selection being placed, and its surroundings."""

    points: NDArray[np.float64]  # centers of some of its Gaussians, from the center of all. [P,3]
    up: Vec3  # unit vector
    ground: float  # height of the ground along `up`, in the scene's coordinates
    rest: Gaussians  # the scene without the selection


Pivot = Literal["center", "base", "pointer"]
Snap = Literal["off", "ground", "surface"]


@dataclass(frozen=True, eq=False)
class GizmoPose:
    """Pose of the handles around a selection, see `Gizmo`."""

    matrix: NDArray[np.float64]  # [4,4]
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)  # degrees


@dataclass(frozen=True)
class Gizmo:
    """Handles around the selection being moved."""

    __eq__ = equal_fields

    does: Literal["transform", "duplicate"]
    center: tuple[float, float, float]  # center of the selection, where the handles start
    # from the original to the current position, about the center; world axes. [4,4]
    matrix: NDArray[np.float64] = field(compare=False)
    using: bool = False  # the mouse drags a handle
    grip: Transform = "move"  # transform of the handle that the mouse drags, or is over
    typed: TypedTransform | None = None  # transform by keys in progress
    # matrix of the last picture, in which the selection has moved. [4,4]
    shown: NDArray[np.float64] = field(default_factory=lambda: np.eye(4), compare=False)
    pivot: Pivot = "center"  # fixed point of rotations and scales; "pointer": as a key begins them
    pivot_at: Vec3 = (0.0, 0.0, 0.0)  # that point of the selection, from its center before the motion
    snap: Snap = "off"  # what the base of the selection is placed on
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)  # typed rotation about X, Y and Z, degrees
    part: PlacedPart | None = field(default=None, compare=False)
    # the last pose at rest, and those that undo and redo return to, the next one last
    rest: GizmoPose = field(default_factory=lambda: GizmoPose(np.eye(4)), compare=False)
    past: tuple[GizmoPose, ...] = field(default=(), compare=False)
    future: tuple[GizmoPose, ...] = field(default=(), compare=False)

    @property
    def is_moved(self) -> bool:
        """True if the selection has been moved, rotated or scaled."""
        return not np.allclose(self.matrix, np.eye(4), atol=1e-9)

    @property
    def enter_request(self) -> str:
        """Name of the request that Enter makes."""
        return "keep_placed"

    @property
    def escape_request(self) -> str:
        """Name of the request that Escape makes."""
        return "put_back"


DecalGrip = Literal["", "move", "scale", "rotate"]


@dataclass(frozen=True)
class Decal:
    """Picture with transparency and its placement in the window."""

    __eq__ = equal_fields

    path: Path
    texture: int  # GL name
    texture_size: tuple[int, int]  # pixels
    opaque: Mask = field(compare=False)  # pixels of the texture that are not transparent. [H,W]
    size: float = 0.0  # longer side, window pixels while it follows the pointer; 0 before the first frame
    angle: float = 0.0  # degrees, counterclockwise
    at: tuple[float, float] | None = None  # center, window pixels; None before the first frame
    level: bool = True  # angles count from the world's up axis, not from the picture's
    frame: DecalFrame | None = None  # on the surface; None where there is none
    mesh: DecalMesh | None = None  # its points on the surface; None while they are unknown
    surface: str = ""  # description of that surface
    placed: bool = False  # handles move it
    grip: DecalGrip = ""  # handle that the mouse drags
    step: tuple[float, float] = (1.0, 0.0)  # size factor and turn in degrees by keys, not applied yet
    laid_for: object = field(default=None, compare=False)  # camera and placement of the mesh
    laid_at: float = field(default=0.0, compare=False)  # when the mesh was laid, on the window's clock

    @property
    def enter_request(self) -> str:
        """Name of the request that Enter makes; "" before the decal is placed."""
        return "lay_decal" if self.placed else ""

    @property
    def escape_request(self) -> str:
        """Name of the request that Escape makes."""
        return "put_back"


Point = tuple[float, float]


@dataclass(frozen=True)
class PullHandle:
    """Handle of a pull: a point of the surface and its displacement."""

    point: Vec3  # position without the pull, world units
    pull: Vec3 = (0.0, 0.0, 0.0)  # displacement, world units
    turn: Vec3 | None = None  # axis times angle, radians, below 2π; None: the surface turns freely
    scale: float = 1.0  # factor of the surface around it

    @property
    def moves(self) -> bool:
        """True if the handle moves, turns or scales anything."""
        return any(self.pull) or any(self.turn or ()) or self.scale != 1.0

    @property
    def target(self) -> Vec3:
        """Position with the pull, world units."""
        (x, y, z), (dx, dy, dz) = self.point, self.pull
        return x + dx, y + dy, z + dz


@dataclass(frozen=True)
class PullCut:
    """Line drawn over a view, which cuts all behind it into two sides."""

    eye: Vec3  # position of the camera, world units
    points: tuple[Vec3, ...]  # its corners, on the surface without the pull, world units


@dataclass(frozen=True)
class PullPose:
    """Handles, held points and cuts of a pull."""

    handles: tuple[PullHandle, ...] = ()
    pins: tuple[Vec3, ...] = ()  # points that stay in place, without the pull, world units
    cuts: tuple[PullCut, ...] = ()


PullAxis = Literal["", "x", "y", "z"]


@dataclass(frozen=True)
class PullDrag:
    """Drag of a handle in progress."""

    index: int  # of the handle
    start: Vec3  # position of the handle at the press, world units
    grab: Point  # from the handle to the pointer, pixels of the picture
    normal: Vec3  # normal of the surface at the handle
    before: PullPose  # the pose before the press
    # visible surface at the press, on which the radius is drawn; None while it is not known
    surface: ViewSurface | None = field(default=None, compare=False)
    axis: PullAxis = ""  # world axis that the handle stays on; "" for the plane of the view
    is_new: bool = False  # the press created the handle, which becomes a pin if it does not move
    moved: bool = False  # the pointer moved further than a click


@dataclass(frozen=True)
class PullTransform:
    """Transform of the picked handle in progress."""

    before: PullPose  # the pose before it
    typed: TypedTransform | None = None  # None: the mouse drags a part of the gizmo


@dataclass(frozen=True)
class CutStroke:
    """Line of a cut while it is drawn."""

    cut: PullCut
    shown: tuple[Vec3, ...]  # its corners where the pull has moved them, world units
    pixel: Point  # last corner, pixels of the picture
    depth: float  # depth of the last corner, which corners on the background take
    offset: Vec3 = (0.0, 0.0, 0.0)  # displacement of the last corner on the surface
    is_on_surface: bool = False  # a corner is on the surface


@dataclass(frozen=True, eq=False)
class PullInfluence:
    """Gaussians that a pull can move."""

    rows: NDArray[np.int64]  # [M]
    shares: NDArray[np.float64]  # share of the handles' motion that each may follow, 0 to 1. [M]
    is_cut: bool = False  # cuts separate a Gaussian from the handles


@dataclass(frozen=True)
class Pull:
    """Pull tool with its handles."""

    radius: float  # radius of the influence around each handle, world units
    whole: bool = False  # the pull reaches all that is connected, regardless of the radius
    holds_selection: bool = False  # the selection stays in place; if False, only the selection moves
    pose: PullPose = PullPose()
    past: tuple[PullPose, ...] = ()  # earlier poses that undo returns to
    future: tuple[PullPose, ...] = ()  # undone poses, the next one last
    drag: PullDrag | None = None
    is_cutting: bool = False  # the left button draws cuts
    stroke: CutStroke | None = None  # cut that is being drawn
    picked: int | None = None  # handle with the gizmo, an index
    transform: PullTransform | None = None  # transform of the picked handle in progress
    grip: Transform = "move"  # transform of the part of its gizmo that the mouse drags, or is over
    hovered: Vec3 | None = None  # point of the surface under the pointer, world units
    hovered_for: object = field(default=None, compare=False)  # pointer and picture of that point
    status: str = ""  # progress, or the reason why the pull cannot be shown; one line
    edit: Gdf | None = field(default=None, compare=False)  # the edit in progress, on screen
    influence: PullInfluence | None = field(default=None, compare=False)  # of this edit

    @property
    def enter_request(self) -> str:
        """Name of the request that Enter makes."""
        return "keep_pull"

    @property
    def escape_request(self) -> str:
        """Name of the request that Escape makes; "" while it only ends a drag or the drawing of cuts."""
        return "" if self.is_held or self.is_cutting else "leave_pull"

    @property
    def is_held(self) -> bool:
        """True while a handle is dragged, turned or scaled, or a cut is drawn."""
        return self.drag is not None or self.transform is not None or self.stroke is not None

    @property
    def picked_handle(self) -> PullHandle | None:
        """Handle with the gizmo; None for none."""
        if self.picked is None or self.picked >= len(self.pose.handles):
            return None
        return self.pose.handles[self.picked]


@dataclass(frozen=True)
class Measure:
    """Measured points of the surface."""

    points: tuple[Vec3, ...] = ()  # at most two, in the scene's coordinates

    @property
    def distance(self) -> float | None:
        """Distance of the two points, world units; None without two."""
        return float(np.linalg.norm(np.subtract(*self.points))) if len(self.points) == 2 else None


@dataclass(frozen=True)
class PreviewGhost:
    """Preview of an edit in training, drawn in its view until the edit has a layer."""

    run: Path  # folder of the run
    cover: Cover


@dataclass(frozen=True)
class DecalGhost:
    """Decal in training, drawn until its layer replaces it."""

    run: Path  # folder of the run
    texture: int  # GL name
    mesh: DecalMesh


@dataclass(frozen=True)
class KeyPointer:
    """Pointer of a tool when it is moved by keys."""

    at: tuple[float, float] | None = None  # in the window; None while the mouse moves it
    down: bool = False  # a key holds its button down


@dataclass(frozen=True, eq=False)
class Brushed:
    """Gaussians that a brush can reach, and those it has touched."""

    centers: Centers  # centers of all Gaussians
    reachable: Mask  # Gaussians that are not occluded, or all. [N]
    touched: Mask  # Gaussians touched so far. [N]


@dataclass(frozen=True)
class Gesture:
    """Selection gesture in progress."""

    tool: str  # one of `SELECT_TOOLS`
    mode: str  # one of `SELECT_MODES`
    before: bytes  # selection before the gesture, packed
    path: tuple[Point, ...]  # pointer positions, pixels of the picture; the corners of a polygon
    brushed: Brushed | None = None  # state of a brush
    center: Vec3 | None = None  # center of a sphere, world units
    scale: float = 0.0  # world units per pixel at the center

    @property
    def radius(self) -> float:
        """Radius of a sphere, world units."""
        return self.scale * float(np.hypot(*np.subtract(self.path[-1], self.path[0])))


@dataclass(frozen=True, eq=False)
class Strokes:
    """Scribbles on an object and next to it."""

    on: Rows  # Gaussians under strokes on the object
    beside: Rows  # Gaussians under strokes next to it
    after: bytes  # selection afterwards, packed
    seen: bytes  # Gaussians on the front surface of any view with a stroke, packed
    guessed: bytes  # selected Gaussians that no such view shows, packed


@dataclass(frozen=True)
class Click:
    """Click of "flood" or "color", which follows its tolerance until something else is selected."""

    tool: str  # "flood" or "color"
    mode: str  # one of `SELECT_MODES`
    before: bytes  # selection before the click, packed
    at: Point  # pixels of the picture
    surface: Surface  # surface of the scene on screen at the click
    options: tuple[float, bool]  # tolerance and depth of the last selection
    after: bytes  # selection afterwards, packed
    recorded: bytes  # selection in the undo history, packed


@dataclass(frozen=True, eq=False)
class ColorDrag:
    """Stroke of the color brush or the clone stamp in progress, and its view."""

    stroke: ColorStroke
    camera: ViewCamera
    size: tuple[int, int]  # width and height, pixels
    surface: ViewSurface  # visible surface of the view


@dataclass(frozen=True)
class CloneSource:
    """Source of the clone stamp: a place on the surface, and its distance from the stroke in one view."""

    point: Vec3  # world units
    offset: Point | None = None  # from the stroke to the source, pixels; None before the first stroke
    camera: ViewCamera | None = None  # view of the offset


@dataclass(frozen=True)
class PendingPaint:
    """Paint in training. It stays on screen until its layer is ready."""

    out: Path  # folder of the run
    painted: tuple[PaintedPicture, ...]


@dataclass(frozen=True)
class MouseTool:
    """Mouse drag and gesture in progress, and the last clicks and strokes of the selection tools."""

    # one of `keys.DRAGS`, `DIVIDER`, `PAINT_DRAG`, `COLOR_DRAG`, `SELECT_DRAG` or `AXES_DRAG`; None without a
    # drag
    drag: str | None = None
    stroke: Stroke | None = None  # brush stroke, from its first drag on
    coloring: ColorDrag | None = None  # stroke of the color brush or the clone stamp
    gesture: Gesture | None = None  # gesture of a selection tool; for a polygon also between its clicks
    # the last click of a tool that selects by one click, while it follows the tool's tolerance
    click: Click | None = None
    strokes: tuple[Strokes, ...] = ()  # strokes that a tool spreads, one entry per change
    divider: float = 0.5  # divider before the drag, fraction of the picture's width
    axis: str = ""  # the pressed end of an axis, of `AXES`, or another part of the axes
    # settings of the selection tool and the brushes before a button was pressed
    settings: tuple[SelectTool, Brush, ColorBrush] | None = None


@dataclass(frozen=True)
class StartFile:
    """File on the start page: a recently opened scene or session, or an example."""

    path: Path  # an example's bundle file
    texture: int = 0  # GL name of its picture, 0 for none
    title: str = ""  # "" for the file's name
    line: str = ""  # text below the title
    missing: bool = False  # the file no longer exists


@dataclass(frozen=True)
class Histogram:
    """Open histogram of a property, with its range."""

    property: str = "size"  # key of `viewer.render.properties.PROPERTIES`
    range: tuple[float, float] | None = None  # selected range on the axis
    anchor: float | None = None  # end of the range that stays during a drag
    base: bytes = EMPTY_MASK  # selection before the drag, packed
    mode: str = "new"  # combination with `base`: new, add or subtract


@dataclass(frozen=True)
class Viewpoint:
    """Training camera in the picture."""

    name: str  # of the camera, "" for none
    view: ViewCamera  # view through it
    eye: Vec3  # its center, world units
    corners: tuple[Vec3, ...]  # corners of its picture, from the upper left one clockwise. [4]
    picture: Path | None = None  # its photograph
    camera: Camera | None = field(default=None, compare=False)  # the camera with its size and lens


@dataclass(frozen=True)
class CameraView:
    """View through a training camera."""

    view: ViewCamera  # view with the whole photograph; another view is none through the camera
    photograph: Photograph | None = None  # its photograph


@dataclass(frozen=True)
class Tour:
    """Tour of the window, see `viewer.state.workspace.follow_tour`."""

    step: int  # index of the current step
    before: object = field(compare=False)  # value of the step when it began


@dataclass(frozen=True)
class Transient:
    """Transient state of the window."""

    cover: Cover | None = None  # image drawn over the picture
    preview: PreviewState = PreviewState()  # state of the preview of a new edit
    scope: GradeScope = GradeScope()  # histogram of a grade in the form
    shelf: LookShelf = LookShelf()  # looks for it
    live: tuple[LayerState, ...] = ()  # edits in training, on top of the layer stack
    # handles of a selection being moved, a decal being placed, or the Pull tool
    gizmo: Gizmo | Decal | Pull | None = None
    measure: Measure | None = None  # points of the measure tool while it is active
    viewpoints: tuple[Viewpoint, ...] = ()  # training cameras in the picture
    through: CameraView | None = None  # training camera that the view looks through
    histogram: Histogram | None = None  # histogram over the picture
    ghosts: tuple[DecalGhost | PreviewGhost, ...] = ()  # edits in training that have no layer yet
    pointer: KeyPointer = KeyPointer()  # pointer of the active tool
    tool: MouseTool = MouseTool()  # drag and gesture of the mouse
    clone: CloneSource | None = None  # source of the clone stamp
    pending: tuple[PendingPaint, ...] = ()  # paint whose layers are not ready yet
    recent: tuple[Path, ...] = ()  # recently opened files, for menu and dialogs; the last one first
    start_files: tuple[StartFile, ...] = ()  # recently opened files, for the start page
    examples: tuple[StartFile, ...] = ()  # examples on the start page
    tour: Tour | None = None  # the running tour

    @property
    def has_bar(self) -> bool:
        """True if a part is moved or pulled or a decal placed, with its own bar above the picture."""
        return self.gizmo is not None

    @property
    def takes_clicks(self) -> bool:
        """True if a part is moved, or a decal follows the pointer, so that no tool gets the clicks."""
        return isinstance(self.gizmo, Gizmo) or (isinstance(self.gizmo, Decal) and not self.gizmo.placed)

    @property
    def held_pull(self) -> Pull | None:
        """Pull whose handle is moved, or whose cut is drawn; None for none."""
        return self.gizmo if isinstance(self.gizmo, Pull) and self.gizmo.is_held else None

    @property
    def covers(self) -> tuple[Cover, ...]:
        """Images to draw over the picture in their views, the most important one first."""
        ghosts = [ghost.cover for ghost in reversed(self.ghosts) if isinstance(ghost, PreviewGhost)]
        return tuple(ghosts) if self.cover is None else (self.cover, *ghosts)
