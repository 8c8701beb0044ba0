"""State of the window besides the drawn view, as frozen data, and functions that change single parts of it.

`viewer.state.actions.perform` applies actions. Work that only the window can do (write a file, go full
screen) is appended to `Workspace.requests`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from progdf.gaussians import ZERO, Origin
from progdf.scene.neighbors import Neighborhood
from progdf.scene.scribbles import Scribbles
from progdf.scene.selection import Mask
from progdf.terminal import escape_text
from viewer.camera.view_camera import Bounds, Fit, ViewCamera, keep_camera
from viewer.camera.views import Glide, glide_on
from viewer.state.forms import DeliverOptions, NewEdit

from . import history, timeline
from .commands import Action
from .facts import LayerRow
from .history import Edit, History
from .selection import SelectionState
from .snapshots import SliderSnapshot
from .timeline import Player
from .transient import Tour, Transient
from .view_state import Comparison, ViewState

MESSAGE_S = 6.0  # time that a message stays visible, s
ERROR_S = 15.0  # the same for an error or a message with a button, s
DETAILS_S = 120.0  # the same for an error with details to copy, s
MIN_ZOOM = 0.5  # range of the interface's zoom
MAX_ZOOM = 3.0
NARROWEST_PX = 280.0  # range of the panel's width, pixels at 1×
WIDEST_PX = 520.0
UNSAVED = "• "
"""Prefix of the scene's name while there are unsaved changes."""
PLACES = ("panel", "tools", "options", "view", "comparison", "timeline", "tour")
"""Parts of the window in the order of keyboard focus. Some may be hidden."""


def _no_facts() -> Any:
    raise ValueError("this scene has no neighborhood")


@dataclass(frozen=True)
class SceneFacts:
    """Facts about a scene that do not change while it is open."""

    title: str  # the scene's name
    count: int  # number of drawn rows: Gaussians of the scene and of its edits
    bounds: Bounds  # bounds of the bulk of the scene
    rows: Sequence[LayerRow]  # one per .gdf, indexed by `LayerState.gdf`
    added: int = 0  # number of Gaussians in `count` that edits added
    origin: Origin = ZERO  # world position of the scene's coordinate origin, see `Gaussians.origin`
    scene_counts: tuple[int, ...] = ()  # number of Gaussians of each scene of a view with several
    fit: Fit = keep_camera  # framing of the scene, for the command `frame`
    # framing of a selection, for the command `frame`
    fit_members: Callable[[ViewCamera, float, Mask], ViewCamera] = lambda camera, *_: camera
    home: Fit = keep_camera  # first view, for the up axis of the given camera
    # computed on first use: for changes of the selection, and for scribble strokes
    neighborhood: Callable[[], Neighborhood] = _no_facts
    scribbles: Callable[[], Scribbles] = _no_facts

    def paint_on(self, view: ViewState, mask: Mask) -> Mask:
        """Return the rows that the view's layers add on some rows, such as paint on an object. [N] -> [N]"""
        paint = np.zeros_like(mask)
        for gdf in {layer.gdf for layer in view.layers if layer.gdf < len(self.rows)}:
            paint[self.rows[gdf].rows_on(mask)] = True
        return paint


CANCEL = "Cancel"
"""Label of a message's button that cancels the work in progress. Escape presses it."""


@dataclass(frozen=True)
class Message:
    """One-line message to the user, visible until a time of the window's clock, in seconds."""

    text: str
    until: float
    error: bool = False
    details: str = ""  # details of an internal error, to be copied into a report
    button: tuple[str, Action] | None = None  # label and command of its button

    @property
    def cancel(self) -> Action | None:
        """Command that cancels the work that the message is about; None for other messages."""
        return self.button[1] if self.button is not None and self.button[0] == CANCEL else None


@dataclass(frozen=True)
class Question:
    """One-line question below the axes of the picture, visible until it is answered or closed."""

    text: str
    buttons: tuple[tuple[str, Action], ...]  # label and command of each
    error: bool = False


@dataclass(frozen=True)
class Dialog:
    """Open dialog."""

    kind: str  # key of `dialogs.TITLES`
    text: str = ""  # content of the path field; in a dialog without one, the file concerned
    then: Action | None = None  # command to continue with afterwards
    item: int | None = None  # the layer or job concerned
    file: str = ""  # the edit to rebind
    notice: str = ""  # one line about the desktop's file dialog, "" for none
    choosing: bool = False  # whether the desktop's file dialog is open
    chosen: str = ""  # file chosen in it
    error: str = ""  # reason why the path was rejected, in one line; "" for none
    options: DeliverOptions | None = None  # options of the requested picture or film


JobStatus = Literal["queued", "running", "stopping", "stopped", "failed", "done"]


@dataclass(frozen=True)
class JobCard:
    """Training, export or render job, as its card in the panel shows it."""

    number: int  # of the job in the queue
    name: str
    out: Path  # its file or folder
    status: JobStatus = "queued"
    training: str = ""  # editor and region of a training, "" for an export or a picture
    label: str = ""  # current step
    share: float = 0.0  # share that is done, 0 to 1
    loss: str = ""  # loss of the training, "" without one
    seconds_left: float | None = None  # None before there is an estimate
    error: str = ""  # one line about a failure
    warning: str = ""  # one line about a poor result
    keepable: bool = False  # its newest recording can become a layer
    delivered: bool = False  # the edit is written, and only its report is left
    sends_pictures: bool = False  # a server makes its pictures; a stop waits for those that it is making
    offer: str = ""  # one line about a possible continuation of the edit
    elsewhere: str = ""  # name of its scene while another one is open
    fills: int | None = None  # `LayerState.gdf` of the removal whose hole it fills


Pointed = tuple[str, int]
"""Panel item under the mouse: "layer" or "region" and its index, or ("selection", 0)."""


REGIONS_OF_EDITS = "Regions of edits"
"""Section of the panel with the regions that training made, folded at first."""


@dataclass(frozen=True)
class Layout:
    """Layout of the window, saved between sessions."""

    zoom: Annotated[float, Meta(ge=MIN_ZOOM, le=MAX_ZOOM)] = 1.0  # scale of the interface
    panel_px: Annotated[float, Meta(ge=NARROWEST_PX, le=WIDEST_PX)] = 300.0  # panel width, pixels at 1×
    folded: tuple[str, ...] = (REGIONS_OF_EDITS,)  # folded sections of the panel
    reduced_motion: bool = False  # the camera jumps instead of gliding
    status: bool = False  # show the status line
    toured: bool = False  # the tour was finished or skipped

    def with_panel(self, wide: float) -> Layout:
        """Return the layout with this panel width, in pixels at 1×, clamped and rounded."""
        return replace(self, panel_px=min(max(float(round(wide)), NARROWEST_PX), WIDEST_PX))


@dataclass(frozen=True)
class Workspace:
    """State of the window: the view, its history, focus, dialogs, jobs and layout."""

    view: ViewState
    past: History  # undo and redo
    home: ViewCamera  # the first camera
    focus: int | None = None  # index of the focused layer in `view.layers`
    # `LayerState.gdf` of the selected layers, empty if only the focused layer is selected
    selected: frozenset[int] = frozenset()
    search: str = ""  # filter of the panel's layers, "" for all
    searching: bool = False  # the search field opens and has no keyboard focus yet
    cards_fit: bool = True  # whether the panel has room for full cards
    active_slider: str = "strength"  # slider that the arrow keys move, one of `layers.SLIDERS`
    renaming: int | None = None  # index of the layer being renamed
    help: bool = False  # whether the key list is open
    help_query: str = ""  # search text of the key list
    keyboard: str = ""  # part of the window with keyboard focus, one of `PLACES`, "" for the picture
    keyboard_by: int = 1  # direction of the last focus change, 1 or −1
    palette: int | None = None  # active line of the command palette, −1 when it opens
    query: str = ""  # search text of the palette
    history: bool | None = None  # state of the history list: True when it opens, then False, None if closed
    message: Message | None = None  # line at the bottom of the picture
    question: Question | None = None  # line below the axes
    settings_opening: bool = False  # the view settings open in the next frame
    snapshots: tuple[SliderSnapshot, ...] = ()  # without the original
    # last saved state, see `saved_state`; None before `mark_saved`
    saved: tuple[Edit, tuple[SliderSnapshot, ...]] | None = None
    dialog: Dialog | None = None  # the open dialog
    requests: tuple[Action, ...] = ()  # pending work that only the window can do
    player: Player = Player()  # the playhead of `view.timeline`
    pointed: Pointed | None = None  # panel item under the mouse, highlighted in the picture
    form: NewEdit = NewEdit()  # form of a new edit, as last left
    form_open: bool = False  # whether the form is open
    form_opening: bool = False  # the form opens and has no keyboard focus yet
    # running and waiting training, export and render jobs, as of the last poll
    jobs: tuple[JobCard, ...] = ()
    before: bool = False  # show the original until its key is pressed again or a slider moves
    glide: Glide | None = None  # running animation of the camera
    layout: Layout = Layout()
    session: str = ""  # name of the session file, "" before there is one
    transient: Transient = Transient()

    @property
    def shows_edit(self) -> bool:
        """True if there is an edit to compare with the original: a layer, or the live edit of the form."""
        form = self.form
        is_graded = (
            self.form_open and form.preview and form.choice.setting == "grade" and form.spec != "grade"
        )
        return bool(self.view.layers or self.transient.live) or is_graded


class Store:
    """Holder of the window's workspace. The parts of the window read and replace it only here.

    Args:
        workspace: the first state
        wake: requests frames that show a change made outside a frame
    """

    def __init__(self, workspace: Workspace, wake: Callable[[], None] = lambda: None) -> None:
        self._workspace = workspace
        self.wake = wake

    def get(self) -> Workspace:
        """Return the current workspace."""
        return self._workspace

    def replace(self, workspace: Workspace) -> None:
        """Set the workspace from now on."""
        self._workspace = workspace

    def change(self, view: ViewState) -> None:
        """Set a new view and request frames; a change of its edits becomes an undo entry."""
        self.replace(record_undo(replace(self._workspace, view=view)))
        self.wake()


def new_workspace(view: ViewState, snapshots: tuple[SliderSnapshot, ...] = ()) -> Workspace:
    """Return a workspace for a new view, with the top layer focused and nothing unsaved."""
    past = history.begin(view, snapshots)
    focus = len(view.layers) - 1 if view.layers else None
    return mark_saved(Workspace(view, past, view.camera, focus, snapshots=snapshots))


def saved_state(workspace: Workspace) -> tuple[Edit, tuple[SliderSnapshot, ...]]:
    """Return the saved part of the workspace: edits, regions and snapshots, without camera and selection."""
    edit = history.edit_of(workspace.view)
    return replace(edit, selection=SelectionState(regions=edit.selection.regions)), workspace.snapshots


def mark_saved(workspace: Workspace) -> Workspace:
    """Mark the current state as saved."""
    return replace(workspace, saved=saved_state(workspace))


def has_unsaved(workspace: Workspace) -> bool:
    """Return whether closing would lose unsaved work."""
    return workspace.saved != saved_state(workspace)


def with_transient(workspace: Workspace, **changes: Any) -> Workspace:
    """Return the workspace with these attributes of its transient state."""
    return replace(workspace, transient=replace(workspace.transient, **changes))


def with_tool(workspace: Workspace, **changes: Any) -> Workspace:
    """Return the workspace with these attributes of the drag and gesture of the mouse."""
    return with_transient(workspace, tool=replace(workspace.transient.tool, **changes))


def original(view: ViewState) -> ViewState:
    """Return the view without any edit or comparison."""
    layers = tuple(replace(layer, enabled=False, solo=False) for layer in view.layers)
    return replace(view, layers=layers, compare=Comparison())


def with_message(
    workspace: Workspace,
    text: str,
    now: float,
    error: bool = False,
    details: str = "",
    seconds: float = MESSAGE_S,
    button: tuple[str, Action] | None = None,
) -> Workspace:
    """Show a one-line message at the bottom of the picture.

    Args:
        workspace: the workspace
        text: the message, put on one line and escaped
        now: current time of the window's clock, s
        error: mark it as an error
        details: details to copy into a report
        seconds: time that it stays visible, unless it is an error or has details or a button
        button: label and command of its button
    """
    if details:
        seconds = DETAILS_S
    elif error or button:
        seconds = ERROR_S
    return replace(workspace, message=Message(on_one_line(text), now + seconds, error, details, button))


def with_question(
    workspace: Workspace, text: str, buttons: Sequence[tuple[str, Action]], error: bool = False
) -> Workspace:
    """Show a one-line question with its buttons until it is answered. It replaces an earlier one.

    Args:
        workspace: the workspace
        text: the question, put on one line and escaped
        buttons: label and command of each
        error: mark it as an error
    """
    return replace(workspace, question=Question(on_one_line(text), tuple(buttons), error))


def on_one_line(text: str) -> str:
    """Return a text on one line, with escaped control characters."""
    return escape_text(" ".join(text.split()))


def record_undo(workspace: Workspace) -> Workspace:
    """Record a finished gesture as one undo entry, with its auto keys.

    Call it when no gesture is in progress.
    """
    if workspace.glide is None:
        layers = workspace.past.present.edit.layers
        view, player = timeline.auto_key(workspace.view, workspace.player, layers)
        if player is not workspace.player:
            workspace = replace(workspace, view=view, player=player)
    past = history.record(workspace.past, workspace.view, workspace.snapshots)
    return workspace if past is workspace.past else replace(workspace, past=past)


def cancel_drag(workspace: Workspace) -> Workspace:
    """Restore the state before the gesture in progress."""
    return replace(workspace, view=history.apply_present(workspace.view, workspace.past))


def advance(workspace: Workspace, seconds: float) -> Workspace:
    """Advance playback and the camera's glide by `seconds`."""
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
    """Return whether moving the playhead to `after` discards strengths that are not stored in keys."""
    before = workspace.view
    frame = workspace.player.frame
    if after.layers == before.layers or history.edit_of(before) != workspace.past.present.edit:
        return False
    return timeline.state_at(before.timeline, frame, before, timeline.MIN_KEYS).layers != before.layers


def with_camera(workspace: Workspace, camera: ViewCamera) -> Workspace:
    """Set the camera, without an undo entry."""
    view = replace(workspace.view, camera=camera)
    return replace(workspace, view=view, past=history.follow_look(workspace.past, workspace.view, view))


def glide_from(workspace: Workspace, start: ViewCamera) -> Workspace:
    """Glide from the camera `start` to the current camera instead of jumping."""
    end = workspace.view.camera
    return replace(with_camera(workspace, start), glide=Glide(start, end)) if end != start else workspace


def focus_layer(workspace: Workspace, index: int) -> Workspace:
    """Focus a layer and select it alone. An invalid index changes nothing."""
    exists = 0 <= index < len(workspace.view.layers)
    return replace(workspace, focus=index, selected=frozenset()) if exists else workspace


def is_compact(workspace: Workspace) -> bool:
    """Return whether the panel shows compact layer rows, by the user's choice or because cards do not fit."""
    view = workspace.view
    return view.cards == "compact" or (view.cards == "auto" and not workspace.cards_fit)


def change_focused(workspace: Workspace, change: Callable[[ViewState, int], ViewState]) -> Workspace:
    """Apply `change` to the focused layer, if there is one; it receives the view and the layer's index."""
    if workspace.focus is None:
        return workspace
    return replace(workspace, view=change(workspace.view, workspace.focus))


def with_layers_of(workspace: Workspace, view: ViewState) -> Workspace:
    """Replace the view and keep the focus on the same layer at its new position."""
    focus = workspace.focus
    before = workspace.view.layers
    if focus is not None and focus < len(before):
        positions = [i for i, layer in enumerate(view.layers) if layer.gdf == before[focus].gdf]
        focus = focus if focus in positions else next(iter(positions), None)
    return replace(workspace, view=view, focus=focus)


_SHARES = ("export", "export_page", "render_picture", "render_film")
"""Dialogs that export something."""

TOUR_STEPS: dict[str, Callable[[Workspace], object]] = {
    "move": lambda work: work.view.camera,
    "slide": lambda work: tuple(layer.strength for layer in work.view.layers),
    "scribble": lambda work: [strokes for strokes in work.transient.tool.strokes if len(strokes.beside)],
    "grade": lambda work: work.form_open and work.form.choice.setting == "grade",
    "share": lambda work: work.dialog is not None and work.dialog.kind in _SHARES,
}
"""Name of each step of the tour, and the value whose change finishes it."""
STEP_NAMES = (*TOUR_STEPS,)


def start_tour(work: Workspace) -> Workspace:
    """Start the tour from its first step."""
    return _to_step(work, 0)


def follow_tour(work: Workspace, held: bool) -> Workspace:
    """Go to the next step of the tour if the user has done the current one.

    Args:
        held: a mouse button is down, so that the action is not finished
    """
    tour = work.transient.tour
    if tour is None or held:
        return work
    return work if TOUR_STEPS[STEP_NAMES[tour.step]](work) == tour.before else skip_step(work)


def skip_step(work: Workspace) -> Workspace:
    """Go to the next step of the tour; end it after the last one."""
    tour = work.transient.tour
    if tour is None or tour.step + 1 == len(STEP_NAMES):
        return end_tour(work)
    return _to_step(work, tour.step + 1)


def end_tour(work: Workspace) -> Workspace:
    """End the tour, so that no example starts it again."""
    return replace(with_transient(work, tour=None), layout=replace(work.layout, toured=True))


def _to_step(work: Workspace, step: int) -> Workspace:
    return with_transient(work, tour=Tour(step, TOUR_STEPS[STEP_NAMES[step]](work)))
