"""State of the window besides the drawn view, as frozen data, and functions that change single parts of it.

`viewer.state.actions.perform` applies actions. Work that only the window can do (write a file, go full
screen) is appended to `Workspace.requests`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

from msgspec import Meta

from progdf.gaussians import ZERO, Origin
from progdf.scene.neighbors import Neighborhood
from progdf.scene.scribbles import Scribbles
from progdf.scene.selection import Mask
from progdf.terminal import escape_text
from viewer.camera.view_camera import Bounds, Fit, ViewCamera, keep_camera
from viewer.camera.views import Glide, glide_on
from viewer.jobs.job_queue import DeliverOptions, QueuedTask
from viewer.jobs.training import NewEdit

from . import history, timeline
from .facts import LayerRow
from .history import Edit, History
from .selection import SelectionState
from .snapshots import SliderSnapshot
from .timeline import Player
from .view_state import Comparison, ViewState

# how long a line stays, and one with details to copy
MESSAGE_S = 6.0
ERROR_S = 15.0
DETAILS_S = 120.0
MIN_ZOOM = 0.5
MAX_ZOOM = 3.0
NARROWEST_PX = 280.0
WIDEST_PX = 520.0
UNSAVED = "• "
"""Before the scene's name where there are unsaved changes."""
PLACES = ("panel", "tools", "options", "view", "comparison", "timeline")
"""Parts of the window through which the keyboard goes, in its order; not all are always shown."""


class PreviewState(NamedTuple):
    """What the form of a new edit says of its picture."""

    text: str = ""  # a word such as "drawing", or why there is none
    failed: bool = False  # whether it is that
    busy: bool = False  # a model paints
    painted: bool = False  # a sentence's picture is there
    models: tuple[str, ...] = ()  # that are on this machine
    sheet: int = 0  # GL name of the paintings of this view, see `SHEET_PX`
    styles: frozenset[int] = frozenset()  # which of them are there


def _no_facts() -> Any:
    raise ValueError("nothing is known of this scene's neighborhood")


@dataclass(frozen=True)
class SceneFacts:
    """What does not change while a scene is open."""

    title: str  # the scene's name
    count: int  # Gaussians in the scene and of its edits: the rows that are drawn
    bounds: Bounds  # of the bulk of the scene
    rows: Sequence[LayerRow]  # one per .gdf, indexed by `LayerState.gdf`
    added: int = 0  # of these, how many edits have added
    origin: Origin = ZERO  # where in the world the scene and its cameras begin, see `Gaussians.origin`
    fit: Fit = keep_camera  # gives the camera that `frame` takes with nothing selected and no layer focused
    # the same for what is selected
    fit_members: Callable[[ViewCamera, float, Mask], ViewCamera] = lambda camera, *_: camera
    home: Fit = keep_camera  # gives the first camera for another up axis, which is the given camera's
    # of the scene's Gaussians, made when it is first asked for; and what strokes spread over
    neighborhood: Callable[[], Neighborhood] = _no_facts
    scribbles: Callable[[], Scribbles] = _no_facts


@dataclass(frozen=True)
class Message:
    """One line for the person, shown until this time of the window's clock in seconds."""

    text: str
    until: float
    error: bool = False
    details: str = ""  # of a mistake of ours, to be copied into a report
    button: tuple[str, str] = ("", "")  # what can be done now: its name and its action


@dataclass(frozen=True)
class Dialog:
    """A question that is being asked."""

    kind: str  # of `dialogs.TITLES`
    text: str = ""  # what stands in the path field; where there is none, the file that the question is about
    then: str = ""  # the request that was put off for this, "" for none; for "replace" the layer's index
    notice: str = ""  # a line about the desktop's own dialog, "" for none
    choosing: bool = False  # that dialog is on screen
    chosen: str = ""  # the file that was chosen in it
    error: str = ""  # why the path did not serve, one line, "" where it was not tried
    options: DeliverOptions | None = None  # of a picture or film that is asked for


Pointed = tuple[str, int]
"""What the mouse rests on in the panel: "layer" or "region" and which of them, or ("selection", 0)."""


@dataclass(frozen=True)
class Layout:
    """How the window is laid out, remembered from one day to the next."""

    zoom: Annotated[float, Meta(ge=MIN_ZOOM, le=MAX_ZOOM)] = 1.0  # of the interface
    panel_px: Annotated[float, Meta(ge=NARROWEST_PX, le=WIDEST_PX)] = 300.0  # at 1×: the panel's width
    folded: tuple[str, ...] = ()  # sections of the panel
    reduced_motion: bool = False  # the camera jumps where it would glide

    def with_panel(self, wide: float) -> Layout:
        """With the panel so wide, as far as it may be."""
        return replace(self, panel_px=min(max(float(round(wide)), NARROWEST_PX), WIDEST_PX))


@dataclass(frozen=True)
class Workspace:
    """The state on screen, how it came about, and what is focused."""

    view: ViewState  # what decides the picture
    past: History  # undo and redo
    home: ViewCamera  # the first camera
    focus: int | None = None  # the focused layer, an index into `view.layers`, or None
    # `LayerState.gdf` of the layers that are selected with it, empty where it is alone
    selected: frozenset[int] = frozenset()
    search: str = ""  # what the panel's layers are filtered by, "" for all
    searching: bool = False  # its field was asked for and has no keyboard yet
    cards_fit: bool = True  # whether the panel has room for a whole card of each layer
    active_slider: str = "strength"  # which of `layers.SLIDERS` of the focused layer the arrow keys move
    renaming: int | None = None  # the layer whose name is being typed, or None
    help: bool = False  # whether the list of keys is shown
    keyboard: str = ""  # of `PLACES`: the part of the window that has the keyboard, "" for the picture
    keyboard_by: int = 1  # which way it went there
    palette: int | None = None  # the line of the list of commands that Enter takes, −1 as it opens; or None
    query: str = ""  # what is sought in that list
    history: bool | None = None  # whether the list of the history is open; True as it opens, then False
    message: Message | None = None  # the line at the bottom, or None
    snapshots: tuple[SliderSnapshot, ...] = ()  # kept states, without the original
    # what a session file holds of this; None where there is none
    saved: tuple[Edit, tuple[SliderSnapshot, ...]] | None = None
    dialog: Dialog | None = None  # the question being asked, or None
    requests: tuple[str, ...] = ()  # what only the window can do, and has still to
    player: Player = Player()  # the playhead of `view.timeline`
    pointed: Pointed | None = None  # what the mouse rests on in the panel, to be seen in the picture
    form: NewEdit = NewEdit()  # of a new edit, as it was last left
    form_open: bool = False  # whether it is shown
    form_opening: bool = False  # it was opened and has no keyboard yet
    # what is being trained, exported and rendered, or waits for that, as the window last looked
    jobs: tuple[QueuedTask, ...] = ()
    before: bool = False  # the original is shown, until its key is pressed again or a slider moves
    glide: Glide | None = None  # the camera on its way to a view that was asked for, or None
    layout: Layout = Layout()  # of the window
    session: str = ""  # the name of its file, "" before it has one


def new_workspace(view: ViewState, snapshots: tuple[SliderSnapshot, ...] = ()) -> Workspace:
    """A workspace on a fresh state; the top layer is focused."""
    past = history.begin(view, snapshots)
    focus = len(view.layers) - 1 if view.layers else None
    return mark_saved(Workspace(view, past, view.camera, focus, snapshots=snapshots))


def worth_saving(workspace: Workspace) -> tuple[Edit, tuple[SliderSnapshot, ...]]:
    """What it would be a pity to lose; where one looked from, and what is selected, is not."""
    edit = history.edit_of(workspace.view)
    return replace(edit, selection=SelectionState(regions=edit.selection.regions)), workspace.snapshots


def mark_saved(workspace: Workspace) -> Workspace:
    """The same, with nothing unsaved."""
    return replace(workspace, saved=worth_saving(workspace))


def has_unsaved(workspace: Workspace) -> bool:
    """Whether closing now would lose something."""
    return workspace.saved != worth_saving(workspace)


def original(view: ViewState) -> ViewState:
    """The same view without any edit."""
    layers = tuple(replace(layer, enabled=False, solo=False) for layer in view.layers)
    return replace(view, layers=layers, compare=Comparison())


def with_message(
    workspace: Workspace,
    text: str,
    now: float,
    error: bool = False,
    details: str = "",
    seconds: float = MESSAGE_S,
    button: tuple[str, str] = ("", ""),
) -> Workspace:
    """With one line at the bottom of the picture for a while; `now`: seconds of the window's clock."""
    until = now + (DETAILS_S if details else ERROR_S if error or button[0] else seconds)
    text = escape_text(" ".join(text.split()))
    return replace(workspace, message=Message(text, until, error, details, button))


def record_undo(workspace: Workspace) -> Workspace:
    """Call when no gesture is under way: what it changed becomes one undo entry, with its keys."""
    if workspace.glide is None:
        layers = workspace.past.present.edit.layers
        view, player = timeline.auto_key(workspace.view, workspace.player, layers)
        if player is not workspace.player:
            workspace = replace(workspace, view=view, player=player)
    past = history.record(workspace.past, workspace.view, workspace.snapshots)
    return workspace if past is workspace.past else replace(workspace, past=past)


def cancel_drag(workspace: Workspace) -> Workspace:
    """As it was before the gesture under way."""
    return replace(workspace, view=history.apply_present(workspace.view, workspace.past))


def advance(workspace: Workspace, seconds: float) -> Workspace:
    """After so much time; the film goes on where it is playing, and the camera where it is on its way."""
    if workspace.glide is not None:
        glide = glide_on(workspace.glide, workspace.view.camera, seconds)
        workspace = replace(workspace, glide=glide)
        workspace = with_camera(workspace, glide.camera) if glide is not None else workspace
    if not workspace.player.playing:
        return workspace
    view = workspace.view
    player = timeline.advance(workspace.player, view.timeline, seconds)
    view = timeline.state_at(view.timeline, player.frame, view, timeline.MIN_KEYS)
    past = history.follow_look(workspace.past, workspace.view, view)
    if loses_strengths(workspace, view):
        past = history.record(past, view, workspace.snapshots)
    else:
        past = history.follow_playhead(past, workspace.view, view)
    return replace(workspace, view=view, player=player, past=past)


def loses_strengths(workspace: Workspace, after: ViewState) -> bool:
    """Whether a playhead that leaves its frame takes strengths away that nobody set a key for."""
    before = workspace.view
    frame = workspace.player.frame
    if after.layers == before.layers or history.edit_of(before) != workspace.past.present.edit:
        return False
    return timeline.state_at(before.timeline, frame, before, timeline.MIN_KEYS).layers != before.layers


def with_camera(workspace: Workspace, camera: ViewCamera) -> Workspace:
    """Looking from elsewhere; never an undo entry."""
    view = replace(workspace.view, camera=camera)
    return replace(workspace, view=view, past=history.follow_look(workspace.past, workspace.view, view))


def glide_from(workspace: Workspace, start: ViewCamera) -> Workspace:
    """From where one looked on to where the camera is now, in place of a jump."""
    end = workspace.view.camera
    return replace(with_camera(workspace, start), glide=Glide(start, end)) if end != start else workspace


def focus_layer(workspace: Workspace, index: int) -> Workspace:
    """With another layer focused, and it alone selected; as it was where there is no such layer."""
    exists = 0 <= index < len(workspace.view.layers)
    return replace(workspace, focus=index, selected=frozenset()) if exists else workspace


def is_compact(workspace: Workspace) -> bool:
    """Whether the panel shows layers as rows of one line: where the person says so, or cards do not fit."""
    view = workspace.view
    return view.cards == "compact" or (view.cards == "auto" and not workspace.cards_fit)


def change_focused(workspace: Workspace, change: Callable[[ViewState, int], ViewState]) -> Workspace:
    """With the focused layer changed, if one is; `change` gets its index."""
    if workspace.focus is None:
        return workspace
    return replace(workspace, view=change(workspace.view, workspace.focus))


def with_layers_of(workspace: Workspace, view: ViewState) -> Workspace:
    """Another state; the focus stays on its layer, wherever that has gone."""
    focus = workspace.focus
    before = workspace.view.layers
    if focus is not None and focus < len(before):
        places = [i for i, layer in enumerate(view.layers) if layer.gdf == before[focus].gdf]
        focus = focus if focus in places else next(iter(places), None)
    return replace(workspace, view=view, focus=focus)
