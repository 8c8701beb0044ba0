"""What the window knows besides the picture's state, and every action on it as a pure function.

Keys, panel buttons and tests all go through `perform`; what only the window itself can do (write a file, go
full screen) is left in `requests` for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from progdf.compose.layers import BLENDS
from progdf.terminal import printable
from viewer.camera import controls
from viewer.camera.view_camera import FARTHEST, Bounds, Fit, ViewCamera, keep_camera

from . import comparison as compare
from . import history, paint, playback, snapshots, timeline
from . import layers as stack
from .history import Edit, History
from .layer_facts import LayerRow
from .playback import Player
from .recordings import RecordingFile
from .snapshots import SliderSnapshot
from .view_state import Comparison, ViewState, next_resolution_mode

MESSAGE_S, ERROR_S = 6.0, 15.0  # how long a line stays
UNSAVED = "• "
"""Before the scene's name where there are unsaved changes."""
FEATHER = 0.1
"""How wide "feather" makes the edges of a layer's paint, share of the radius of its region."""


@dataclass(frozen=True)
class SceneFacts:
    """What does not change while a scene is open.

    Args:
        title: the scene's name
        count: Gaussians in the scene
        bounds: of the bulk of the scene
        rows: one per .gdf, indexed by `LayerState.gdf`
        recordings: where each .gdf was recorded, in the same order
        fit: gives the camera that `frame` takes with no layer focused
        home: gives the first camera for another up axis, which is the given camera's
    """

    title: str
    count: int
    bounds: Bounds
    rows: Sequence[LayerRow]
    recordings: Sequence[RecordingFile] = ()
    fit: Fit = keep_camera
    home: Fit = keep_camera


@dataclass(frozen=True)
class Message:
    """One line for the person, shown until this time of the window's clock in seconds."""

    text: str
    until: float
    error: bool = False


@dataclass(frozen=True)
class Dialog:
    """A question that is being asked.

    Args:
        kind: of `dialogs.TITLES`
        text: what stands in the path field; where there is none, the file that the question is about
        then: the request that was put off for this, "" for none; for "replace" the layer's index
        notice: a line about the desktop's own dialog, "" for none
        choosing: that dialog is on screen
        chosen: the file that was chosen in it
        error: why the path did not serve, one line, "" where it was not tried
    """

    kind: str
    text: str = ""
    then: str = ""
    notice: str = ""
    choosing: bool = False
    chosen: str = ""
    error: str = ""


@dataclass(frozen=True)
class Workspace:
    """The state on screen, how it came about, and what is focused.

    Args:
        view: what decides the picture
        past: undo and redo
        home: the first camera
        focus: the focused layer, an index into `view.layers`, or None
        active_slider: which of `stack.SLIDERS` of the focused layer the arrow keys move
        renaming: the layer whose name is being typed, or None
        help: whether the list of bindings is shown
        message: the line at the bottom, or None
        snapshots: kept states, without the original
        saved: what a session file holds of this; None where there is none
        dialog: the question being asked, or None
        requests: what the window has still to do, see `REQUESTS`
        player: the playhead of `view.timeline`
        overlap: the layer of which the panel asks to see what it shares with the others, or None
    """

    view: ViewState
    past: History
    home: ViewCamera
    focus: int | None = None
    active_slider: str = "strength"
    renaming: int | None = None
    help: bool = False
    message: Message | None = None
    snapshots: tuple[SliderSnapshot, ...] = ()
    saved: tuple[Edit, tuple[SliderSnapshot, ...]] | None = None
    dialog: Dialog | None = None
    requests: tuple[str, ...] = ()
    player: Player = Player()
    overlap: int | None = None


def new_workspace(view: ViewState, kept: tuple[SliderSnapshot, ...] = ()) -> Workspace:
    """A workspace on a fresh state; the top layer is focused."""
    past, focus = history.begin(view, kept), len(view.layers) - 1 if view.layers else None
    return mark_saved(Workspace(view, past, view.camera, focus, snapshots=kept))


def worth_saving(workspace: Workspace) -> tuple[Edit, tuple[SliderSnapshot, ...]]:
    """What it would be a pity to lose; where one looked from is not."""
    return history.edit_of(workspace.view), workspace.snapshots


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


def with_message(workspace: Workspace, text: str, now: float, error: bool = False) -> Workspace:
    """With one line at the bottom of the picture for a while; `now`: seconds of the window's clock."""
    until = now + (ERROR_S if error else MESSAGE_S)
    return replace(workspace, message=Message(printable(" ".join(text.split())), until, error))


def record_undo(workspace: Workspace) -> Workspace:
    """Call when no gesture is under way: what it changed becomes one undo entry."""
    past = history.record(workspace.past, workspace.view, workspace.snapshots)
    return workspace if past is workspace.past else replace(workspace, past=past)


def cancel_drag(workspace: Workspace) -> Workspace:
    """As it was before the gesture under way."""
    return replace(workspace, view=history.apply_edit(workspace.view, workspace.past.present.edit))


def advance(workspace: Workspace, seconds: float) -> Workspace:
    """After so much time; the film goes on where it is playing."""
    if not workspace.player.playing:
        return workspace
    view = workspace.view
    player = playback.advance(workspace.player, view.timeline, seconds)
    view = timeline.state_at(view.timeline, player.frame, view, playback.LEAST_KEYS)
    if _loses_strengths(workspace, view):
        past = history.record(workspace.past, view, workspace.snapshots)
    else:
        past = history.follow_playhead(workspace.past, workspace.view, view)
    return replace(workspace, view=view, player=player, past=past)


def _loses_strengths(workspace: Workspace, after: ViewState) -> bool:
    """Whether a playhead that leaves its frame takes strengths away that nobody set a key for."""
    before, frame = workspace.view, workspace.player.frame
    if after.layers == before.layers or history.edit_of(before) != workspace.past.present.edit:
        return False
    return timeline.state_at(before.timeline, frame, before, playback.LEAST_KEYS).layers != before.layers


def perform(workspace: Workspace, action: str, facts: SceneFacts, aspect: float = 1.0) -> Workspace:
    """The workspace after an action of `controls.KEYS`.

    Args:
        action: its name, with an argument after a colon where it has one
        facts: of the open scene
        aspect: width / height of the picture

    Raises:
        KeyError: there is no such action.
    """
    name, _, argument = action.partition(":")
    if name in REQUESTS:
        return replace(workspace, requests=(*workspace.requests, action))
    if name in ("frame", "home"):
        return (_frame if name == "frame" else _home)(workspace, facts, aspect)
    if name in ("paint_clear", "paint_fill"):
        return _fill_paint(workspace, facts, 1.0 if name == "paint_fill" else 0.0)
    if name == "paint_feather":
        return _feather(workspace, facts)
    if name == "next_slider":
        return _select_slider(workspace, int(argument), facts)
    return ACTIONS[name](workspace, argument)


def with_camera(workspace: Workspace, camera: ViewCamera) -> Workspace:
    """Looking from elsewhere; never an undo entry."""
    return replace(workspace, view=replace(workspace.view, camera=camera))


def _frame(workspace: Workspace, facts: SceneFacts, aspect: float) -> Workspace:
    """The focused layer, or what the scene is about, fills the picture; the direction stays."""
    fit = facts.fit
    if workspace.focus is not None:
        fit = facts.rows[workspace.view.layers[workspace.focus].gdf].fit
    return with_camera(workspace, fit(workspace.view.camera, aspect))


def _home(workspace: Workspace, facts: SceneFacts, aspect: float) -> Workspace:
    """The first view; under another up axis than then, what would be the first view with that one."""
    camera = workspace.view.camera
    home = replace(workspace.home, up=camera.up, mode=camera.mode)
    if camera.up != workspace.home.up:
        home = facts.home(home, aspect)
    return with_camera(workspace, home)


def focus_layer(workspace: Workspace, index: int) -> Workspace:
    """With another layer focused; as it was where there is no such layer."""
    return replace(workspace, focus=index) if 0 <= index < len(workspace.view.layers) else workspace


def _focus(workspace: Workspace, number: str) -> Workspace:
    """By its number, counted from 1 at the top of the panel's list."""
    return focus_layer(workspace, stack.index_of(workspace.view, int(number) - 1))


def _toggle_shown(view: ViewState, index: int) -> ViewState:
    return stack.change_layer(view, index, lambda layer: replace(layer, enabled=not layer.enabled))


def _toggle(workspace: Workspace, number: str) -> Workspace:
    index = stack.index_of(workspace.view, int(number) - 1)
    return replace(workspace, view=_toggle_shown(workspace.view, index))


def _hide(workspace: Workspace, _: str) -> Workspace:
    return _change_focused(workspace, _toggle_shown)


def _nudge(workspace: Workspace, by: str) -> Workspace:
    return _change_focused(
        workspace, lambda view, i: stack.nudge(view, i, workspace.active_slider, float(by))
    )


def _select_slider(workspace: Workspace, by: int, facts: SceneFacts) -> Workspace:
    """The next active_slider that the focused layer has; its gains unfold, so that one sees which."""
    if workspace.focus is None:
        return workspace
    view, gdf = workspace.view, workspace.view.layers[workspace.focus].gdf
    sliders = [
        active_slider
        for active_slider in stack.SLIDERS
        if active_slider == "strength" or active_slider in facts.rows[gdf].kinds
    ]
    place = sliders.index(workspace.active_slider) if workspace.active_slider in sliders else 0
    active_slider = sliders[(place + by) % len(sliders)]
    if active_slider != "strength" and gdf not in view.unfolded:
        view = replace(view, unfolded=(*view.unfolded, gdf))
    return replace(workspace, active_slider=active_slider, view=view)


def _move(workspace: Workspace, by: str) -> Workspace:
    """The focused layer up (−1) or down in the panel's list; the focus goes with it."""
    if workspace.focus is None:
        return workspace
    to = max(0, min(workspace.focus - int(by), len(workspace.view.layers) - 1))
    return replace(workspace, view=stack.move_layer(workspace.view, workspace.focus, to), focus=to)


def _remove(workspace: Workspace, index: str) -> Workspace:
    """A layer, or the focused one, is taken out of the stack; the one below it is focused."""
    at = int(index) if index else workspace.focus
    if at is None or not 0 <= at < len(workspace.view.layers):
        return workspace
    view = stack.remove_layer(workspace.view, at)
    focus = max(at - 1, 0) if view.layers else None
    return replace(workspace, view=view, focus=focus, renaming=None, overlap=None)


def _rename(workspace: Workspace, index: str) -> Workspace:
    """The name of a layer, or of the focused one, becomes a text field."""
    return replace(workspace, renaming=int(index) if index else workspace.focus)


def _lock(workspace: Workspace, _: str) -> Workspace:
    def turned(view: ViewState, index: int) -> ViewState:
        return stack.change_layer(view, index, lambda layer: replace(layer, locked=not layer.locked))

    return _change_focused(workspace, turned)


def _change_brush(workspace: Workspace, **changes: Any) -> Workspace:
    view = workspace.view
    return replace(workspace, view=replace(view, brush=replace(view.brush, **changes)))


def _fill_paint(workspace: Workspace, facts: SceneFacts, weight: float) -> Workspace:
    """The focused layer painted evenly, unless it is locked."""

    def even(view: ViewState, index: int) -> ViewState:
        count = facts.rows[view.layers[index].gdf].count
        return stack.with_paint(view, index, paint.encode(np.full(count, weight, np.float32)))

    return _change_focused(workspace, even)


def _feather(workspace: Workspace, facts: SceneFacts) -> Workspace:
    """The edges of the focused layer's paint softened a little; again softens them more."""

    def softened(view: ViewState, index: int) -> ViewState:
        layer = view.layers[index]
        row = facts.rows[layer.gdf]
        width = max(FEATHER * row.bounds.radius, FARTHEST**-1)
        return stack.with_paint(view, index, paint.feather(layer.paint, row.points, width))

    return _change_focused(workspace, softened)


def _blend(workspace: Workspace, _: str) -> Workspace:
    after = BLENDS[(BLENDS.index(workspace.view.blend) + 1) % len(BLENDS)]
    return replace(workspace, view=replace(workspace.view, blend=after))


def _change_focused(workspace: Workspace, change: Callable[[ViewState, int], ViewState]) -> Workspace:
    if workspace.focus is None:
        return workspace
    return replace(workspace, view=change(workspace.view, workspace.focus))


def _undo(workspace: Workspace, _: str) -> Workspace:
    return _back(workspace, history.undo(workspace.past))


def _redo(workspace: Workspace, _: str) -> Workspace:
    return _back(workspace, history.redo(workspace.past))


def _back(workspace: Workspace, past: History) -> Workspace:
    if past is workspace.past:
        return workspace
    kept = past.present
    workspace = replace(workspace, past=past, snapshots=kept.snapshots, renaming=None)
    return _with_layers_of(workspace, history.apply_edit(workspace.view, kept.edit))


def _with_layers_of(workspace: Workspace, view: ViewState) -> Workspace:
    """Another state; the focus stays on its layer, wherever that has gone."""
    focus, before = workspace.focus, workspace.view.layers
    if focus is not None and focus < len(before):
        places = [i for i, layer in enumerate(view.layers) if layer.gdf == before[focus].gdf]
        focus = focus if focus in places else next(iter(places), None)
    return replace(workspace, view=view, focus=focus)


def _fly(workspace: Workspace, _: str) -> Workspace:
    return with_camera(workspace, controls.toggle_fly(workspace.view.camera))


def _timeline_action(name: str) -> Callable[[Workspace, str], Workspace]:
    """An action of the timeline."""

    def act(workspace: Workspace, argument: str) -> Workspace:
        view, player = playback.perform(workspace.view, workspace.player, f"{name}:{argument}")
        past = workspace.past
        if _loses_strengths(workspace, view):  # an entry of its own, or part of what is done to the keys
            past = past if name == "move_key" else history.record(past, view, workspace.snapshots)
        elif past.present.edit.layers == workspace.view.layers:
            past = history.follow_playhead(past, workspace.view, view)
        return replace(workspace, view=view, player=player, past=past)

    return act


def _restore(workspace: Workspace, index: str) -> Workspace:
    """Back to a snapshot, counted as the panel shows them: 0 is the original."""
    kept = snapshots.with_original(workspace.snapshots, workspace.view)
    if not 0 <= int(index) < len(kept):
        return workspace
    return _with_layers_of(workspace, snapshots.restore(workspace.view, kept[int(index)]))


def _forget(workspace: Workspace, index: str) -> Workspace:
    return replace(workspace, snapshots=snapshots.remove(workspace.snapshots, int(index) - 1))


def _name_snapshot(workspace: Workspace, argument: str) -> Workspace:
    """`INDEX:NAME`"""
    index, _, name = argument.partition(":")
    return replace(workspace, snapshots=snapshots.rename(workspace.snapshots, int(index) - 1, name))


def _snapshot(workspace: Workspace, _: str) -> Workspace:
    return replace(workspace, snapshots=snapshots.take(workspace.snapshots, workspace.view))


REQUESTS = (
    *("picture", "window_picture", "timeline_file", "camera", "full_screen", "quit"),
    *("save", "save_as", "save_to", "open", "open_file", "browse", "discard"),
    *("overwrite", "restore_autosave", "discard_autosave", "duplicate", "replace", "replace_by"),
)
"""What only the window can do: `save_to:PATH`, `overwrite:PATH`, `open_file:PATH`; `save:THEN` asks for THEN
afterwards; `browse` shows the desktop's own dialog beside the question that is open; `duplicate:INDEX` of a
layer, the focused one where none is named; `replace:INDEX` asks for its new edit, `replace_by:INDEX:PATH`."""
ACTIONS: dict[str, Callable[[Workspace, str], Workspace]] = {
    "focus": _focus,
    "unfocus": lambda w, _: replace(w, help=False) if w.help else replace(w, focus=None),
    "toggle": _toggle,
    "hide": _hide,
    "nudge": _nudge,
    "move": _move,
    "solo": lambda workspace, _: _change_focused(workspace, stack.toggle_solo),
    "show_all": lambda w, _: replace(w, view=stack.show_all(w.view)),
    "lock": _lock,
    "fold": lambda workspace, _: _change_focused(workspace, stack.toggle_details),
    "rename": _rename,
    "remove": _remove,
    "blend": _blend,
    "brush": lambda w, _: _change_brush(w, active=not w.view.brush.active),
    "brush_mode": lambda w, _: _change_brush(w, mode=paint.next_mode(w.view.brush.mode)),
    "brush_weights": lambda w, _: _change_brush(w, weights=not w.view.brush.weights),
    "brush_through": lambda w, _: _change_brush(w, through=not w.view.brush.through),
    "brush_radius": lambda w, by: _change_brush(w, radius=paint.radius(w.view.brush.radius * float(by))),
    "brush_softness": lambda w, by: _change_brush(
        w, softness=paint.softness(w.view.brush.softness + float(by))
    ),
    "overshoot": lambda w, _: replace(w, view=stack.with_overshoot(w.view, not w.view.overshoot)),
    "snapshot": _snapshot,
    "restore": _restore,
    "forget": _forget,
    "name_snapshot": _name_snapshot,
    "undo": _undo,
    "redo": _redo,
    "fly": _fly,
    "help": lambda workspace, _: replace(workspace, help=not workspace.help),
    "split": lambda w, _: replace(w, view=compare.toggle_mode(w.view, "split")),
    "difference": lambda w, _: replace(w, view=compare.toggle_mode(w.view, "difference")),
    "against": lambda w, _: replace(w, view=compare.toggle_against(w.view)),
    "draft": lambda w, _: replace(w, view=next_resolution_mode(w.view)),
    "overlay": lambda w, _: replace(w, view=replace(w.view, overlay=not w.view.overlay)),
    "panel": lambda w, _: replace(w, view=replace(w.view, panel=not w.view.panel)),
    **{name: _timeline_action(name) for name in playback.ACTIONS},
}
