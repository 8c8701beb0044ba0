"""Commands on the workspace as pure functions. Keys, panel buttons and tests all call `perform`.

Commands that only the window can perform (write a file, go full screen) are appended to `Workspace.requests`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from progdf.compose import layer_paint
from progdf.compose.layers import BLENDS
from viewer.camera import controls
from viewer.camera.view_camera import FARTHEST
from viewer.camera.views import look_at_view
from viewer.state.forms import ALL, CHANGED, EDITORS, SELECTION, TYPED, with_editor, with_settings

from . import history, layer_selection, paint, selection, snapshots, timeline
from .commands import Action, ChooseSnapshot, MoveSnapshot, OnItem, Plain, Rename, WithValue, argument
from .history import History
from .layers import (
    SLIDERS,
    change_group,
    change_layer,
    index_of,
    show_all,
    toggle_details,
    with_overshoot,
    with_paint,
)
from .transient import Histogram, Measure
from .view_state import BRUSH_MODES, FRAMES, PAINT_TOOLS, RESOLUTION_MODES, VIEW_MODES, ViewState, following
from .workspace import (
    MAX_ZOOM,
    MIN_ZOOM,
    PLACES,
    SceneFacts,
    Workspace,
    change_focused,
    focus_layer,
    is_compact,
    loses_strengths,
    start_tour,
    with_camera,
    with_layers_of,
    with_transient,
)


def end_at_edit(before: Workspace, after: Workspace) -> Workspace:
    """End a comparison of snapshots if `after` changes layers, groups or the blend rule, so that this is
    visible."""
    view_before = before.view
    view = after.view
    edited = (view.layers, view.groups, view.blend) != (
        view_before.layers,
        view_before.groups,
        view_before.blend,
    )
    if not edited or view.compare.mode == "off" or view.compare.against != "snapshots":
        return after
    uncompared = replace(view, compare=replace(view.compare, mode="off", against="original"))
    return replace(after, view=uncompared, past=history.follow_look(after.past, view, uncompared))


FEATHER = 0.1
"""Width of feathered paint edges, as a share of the radius of the layer's region."""


def perform(workspace: Workspace, action: Action, facts: SceneFacts, aspect: float = 1.0) -> Workspace:
    """Return the workspace after a command. Commands without a handler here become requests to the window.

    Args:
        action: the command
        facts: facts about the open scene
        aspect: width / height of the picture
    """
    if action == Plain("invert"):
        action = Plain("paint_invert" if workspace.view.brush.active else "select_invert")
    name = action.name
    if name in ("focus", "press_layer", "unfocus"):  # focusing a layer deselects the timeline keys
        workspace = replace(workspace, player=replace(workspace.player, chosen=frozenset()))
    if name in ("frame", "home"):
        return (_frame if name == "frame" else _home)(workspace, facts, aspect)
    if name == "flip_up":
        x, y, z = workspace.view.camera.up
        flipped = replace(workspace.view.camera, up=(-x, -y, -z))
        return replace(workspace, view=replace(workspace.view, camera=facts.home(flipped, aspect)))
    if name in ("paint_clear", "paint_fill", "paint_invert", "paint_feather"):
        return _repaint(workspace, name, facts)
    if name in selection.CHANGES:
        view = workspace.view
        changed = selection.change(
            view.selection, action, facts.count, facts.neighborhood, partial(facts.paint_on, view)
        )
        return replace(workspace, view=replace(view, selection=changed))
    if name in OF_EDITS:
        at = action.index if isinstance(action, OnItem) else workspace.focus
        return workspace if at is None else OF_EDITS[name](workspace, at, facts)
    if isinstance(action, WithValue) and name == "next_slider":
        return _select_slider(workspace, int(action.value), facts)
    if name in timeline.ACTIONS:
        return _perform_on_timeline(workspace, action)
    if name in ACTIONS:
        return ACTIONS[name](workspace, argument(action))
    return replace(workspace, requests=(*workspace.requests, action))


def _edit_again(workspace: Workspace, index: int, facts: SceneFacts) -> Workspace:
    """Open the form with the settings of a layer's edit, if one of the form's editors made it."""
    layer = workspace.view.layers[index]
    row = facts.rows[layer.gdf]
    form = with_settings(replace(workspace.form, name=layer.name, error=""), row.instruction)
    if form is None:
        return workspace
    mask = np.zeros(facts.count, bool)
    mask[row.members] = True
    known = workspace.view.selection
    equal = selection.equal_region(known, selection.pack(mask), facts.count)
    if row.region_spec in (ALL, CHANGED):
        form = replace(form, region=row.region_spec)
    elif equal is not None:
        form = replace(form, region=known.regions[equal].name)
    elif row.region_spec:
        form = replace(form, region=TYPED, typed_region=row.region_spec)
    return replace(workspace, form=form, form_open=True, form_opening=True)


def _limit_paint(workspace: Workspace, index: int, facts: SceneFacts) -> Workspace:
    """Limit a layer's paint to the selection. Without a selection nothing changes."""
    view = workspace.view
    row = facts.rows[workspace.view.layers[index].gdf]
    if not view.selection.count:
        return workspace
    weights = selection.unpack(view.selection.members, facts.count)[row.members].astype(np.float32)
    painted = layer_paint.decode(view.layers[index].paint, row.count, row.from_others)
    weights = weights if painted is None else weights * painted.numpy()
    return replace(workspace, view=with_paint(view, index, layer_paint.encode(weights)))


def _select_painted(workspace: Workspace, index: int, facts: SceneFacts) -> Workspace:
    """Select the members of a layer whose paint is at least 0.5, or all members if it is not painted."""
    view = workspace.view
    row = facts.rows[workspace.view.layers[index].gdf]
    painted = layer_paint.decode(view.layers[index].paint, row.count, row.from_others)
    mask = np.zeros(facts.count, bool)
    mask[row.members if painted is None else row.members[painted.numpy() >= 0.5]] = True
    mask |= facts.paint_on(view, mask)
    return replace(workspace, view=replace(view, selection=selection.select(view.selection, mask)))


OF_EDITS = {"again": _edit_again, "limit_to_selection": _limit_paint, "select_painted": _select_painted}
"""Actions on one layer (default: the focused layer) that use `SceneFacts`."""


def _frame(workspace: Workspace, facts: SceneFacts, aspect: float) -> Workspace:
    """Frame the selection, else the focused layer, else the scene. The view direction is unchanged."""
    fit = facts.fit
    selected = workspace.view.selection
    if selected.count:
        mask = selection.unpack(selected.members, facts.count)
        return with_camera(workspace, facts.fit_members(workspace.view.camera, aspect, mask))
    if workspace.focus is not None:
        fit = facts.rows[workspace.view.layers[workspace.focus].gdf].fit
    return with_camera(workspace, fit(workspace.view.camera, aspect))


def _home(workspace: Workspace, facts: SceneFacts, aspect: float) -> Workspace:
    """Return to the first view. If the up axis has changed, compute the first view for the new axis."""
    camera = workspace.view.camera
    home = replace(workspace.home, up=camera.up, mode=camera.mode)
    if camera.up != workspace.home.up:
        home = facts.home(home, aspect)
    return with_camera(workspace, home)


def _view_from(workspace: Workspace, name: str) -> Workspace:
    """Look from a named side or from the end of an axis, see `viewer.camera.views.look_at_view`."""
    return with_camera(workspace, look_at_view(workspace.view.camera, name))


def _focus(workspace: Workspace, number: int) -> Workspace:
    """Focus a layer by its number, counted from 1 at the top of the panel's list."""
    return focus_layer(workspace, index_of(workspace.view, number - 1))


def _toggle(workspace: Workspace, number: int) -> Workspace:
    index = index_of(workspace.view, number - 1)
    view = change_layer(workspace.view, index, lambda layer: replace(layer, enabled=not layer.enabled))
    return replace(workspace, view=view)


def _select_slider(workspace: Workspace, by: int, facts: SceneFacts) -> Workspace:
    """Select the next (1) or previous (−1) slider of the focused layer. For a gain, unfold the details."""
    if workspace.focus is None:
        return workspace
    view = workspace.view
    gdf = workspace.view.layers[workspace.focus].gdf
    sliders = [slider for slider in SLIDERS if slider in ("strength", *facts.rows[gdf].kinds)]
    at = sliders.index(workspace.active_slider) if workspace.active_slider in sliders else 0
    slider = sliders[(at + by) % len(sliders)]
    if slider != "strength" and gdf not in view.unfolded:
        view = replace(view, unfolded=(*view.unfolded, gdf))
    return replace(workspace, active_slider=slider, view=view)


def _rename(workspace: Workspace, index: int | None) -> Workspace:
    """Open the text field for the name of a layer (default: the focused layer)."""
    return replace(workspace, renaming=workspace.focus if index is None else index)


def _change_brush(workspace: Workspace, **changes: Any) -> Workspace:
    view = workspace.view
    return replace(workspace, view=replace(view, brush=replace(view.brush, **changes)))


def _repaint(workspace: Workspace, how: str, facts: SceneFacts) -> Workspace:
    """Fill, clear, invert or feather the focused layer's paint, unless the layer is locked.

    Each feathering softens the edges further.
    """

    def change(view: ViewState, index: int) -> ViewState:
        layer = view.layers[index]
        row = facts.rows[layer.gdf]
        if how == "paint_feather":
            width = max(FEATHER * row.bounds.radius, FARTHEST**-1)
            return with_paint(view, index, paint.feather(layer.paint, row.points, width, row.from_others))
        if how == "paint_invert":
            return with_paint(view, index, paint.invert(layer.paint, row.count, row.from_others))
        uniform = np.full(row.count, how == "paint_fill", np.float32)
        return with_paint(view, index, layer_paint.encode(uniform))

    return change_focused(workspace, change)


def _toggle_tool(workspace: Workspace, tool: str) -> Workspace:
    """Activate a selection tool, or deactivate it if it is active. The brush is deactivated."""
    view = workspace.view
    new_tool = "" if view.select.tool == tool else tool
    view = _without_tools(view)
    return replace(workspace, view=replace(view, select=replace(view.select, tool=new_tool)))


def _toggle_paint_tool(workspace: Workspace, tool: str) -> Workspace:
    """Activate the color brush or the clone stamp, or deactivate it if it is active."""
    if tool not in PAINT_TOOLS:
        return workspace
    new_tool = "" if workspace.view.color_brush.tool == tool else tool
    view = _without_tools(workspace.view)
    return replace(workspace, view=replace(view, color_brush=replace(view.color_brush, tool=new_tool)))


def _without_tools(view: ViewState) -> ViewState:
    """Return the view with no active brush or selection tool."""
    return replace(
        view,
        select=replace(view.select, tool=""),
        brush=replace(view.brush, active=False),
        color_brush=replace(view.color_brush, tool=""),
    )


def _start_pull(workspace: Workspace, _: None) -> Workspace:
    """Deactivate the other tools and request the Pull tool, or its end."""
    return replace(
        workspace, view=_without_tools(workspace.view), requests=(*workspace.requests, Plain("pull"))
    )


def _toggle_measure(workspace: Workspace, _: None) -> Workspace:
    """Activate the measure tool, or deactivate it if it is active. Other tools are deactivated."""
    measure = Measure() if workspace.transient.measure is None else None
    return with_transient(replace(workspace, view=_without_tools(workspace.view)), measure=measure)


def _toggle_histogram(workspace: Workspace, _: None) -> Workspace:
    """Open or close the histogram."""
    histogram = Histogram() if workspace.transient.histogram is None else None
    return with_transient(workspace, histogram=histogram)


def _set_unit(workspace: Workspace, true_length: float) -> Workspace:
    """Set the true length of the measured distance, which sets the unit of length."""
    measure = workspace.transient.measure
    distance = None if measure is None else measure.distance
    if not distance or not math.isfinite(true_length / distance) or true_length <= 0.0:
        return workspace
    return replace(workspace, view=replace(workspace.view, unit=true_length / distance))


def _change_color_brush(workspace: Workspace, **changes: Any) -> Workspace:
    view = workspace.view
    return replace(workspace, view=replace(view, color_brush=replace(view.color_brush, **changes)))


def _switch_mode(workspace: Workspace, _: None) -> Workspace:
    """Switch the color brush between painting and erasing, or the brush of strengths to its next mode."""
    brush = workspace.view.color_brush
    if brush.tool:
        return _change_color_brush(workspace, erases=not brush.erases)
    return _change_brush(workspace, mode=following(BRUSH_MODES, workspace.view.brush.mode))


def _soften(workspace: Workspace, by: float) -> Workspace:
    """Change the softness of the active brush by a share of its radius."""
    view = workspace.view
    if view.color_brush.tool:
        hardness = 1.0 - paint.softness(1.0 - view.color_brush.hardness + by)
        return _change_color_brush(workspace, hardness=round(hardness, 3))
    return _change_brush(workspace, softness=paint.softness(view.brush.softness + by))


def _navigate(workspace: Workspace, mode: str) -> Workspace:
    """Switch to orbit or fly mode and deactivate the brush and the selection tool."""
    camera = replace(workspace.view.camera, mode=mode)
    return with_camera(replace(workspace, view=_without_tools(workspace.view)), camera)


def _zoom(workspace: Workspace, times: float) -> Workspace:
    """Multiply the zoom of the interface by `times`; 0 resets it to 1."""
    zoom = min(max(round(workspace.layout.zoom * times, 3), MIN_ZOOM), MAX_ZOOM)
    return replace(workspace, layout=replace(workspace.layout, zoom=zoom if times else 1.0))


def _toggle_brush(workspace: Workspace, _: None) -> Workspace:
    is_active = workspace.view.brush.active
    return _change_brush(replace(workspace, view=_without_tools(workspace.view)), active=not is_active)


def _resize(workspace: Workspace, times: float) -> Workspace:
    """Scale the radius of the brush or of the active selection tool, or the tool's color tolerance."""
    view = workspace.view
    if view.color_brush.tool:
        return _change_color_brush(workspace, radius=paint.radius(view.color_brush.radius * times))
    if not view.select.tool:
        return _change_brush(workspace, radius=paint.radius(view.brush.radius * times))
    if view.select.tool in ("flood", "color"):
        tolerance = min(1.0, max(0.01, round(view.select.tolerance * times, 3)))
        return replace(workspace, view=replace(view, select=replace(view.select, tolerance=tolerance)))
    radius = paint.radius(view.select.radius * times)
    return replace(workspace, view=replace(view, select=replace(view.select, radius=radius)))


def _close_or_unfocus(workspace: Workspace, _: None) -> Workspace:
    """Close the first active one: key list, work in progress, brush, tool, measure, form, layers, focus."""
    if workspace.help:
        return replace(workspace, help=False)
    cancel = None if workspace.message is None else workspace.message.cancel
    if cancel is not None and workspace.transient.gizmo is None:
        return replace(workspace, message=None, requests=(*workspace.requests, cancel))
    if workspace.view.brush.active:
        return _change_brush(workspace, active=False)
    if workspace.view.color_brush.tool:
        return _change_color_brush(workspace, tool="")
    tool = workspace.view.select.tool
    if tool:
        return _toggle_tool(workspace, tool)
    if workspace.transient.measure is not None:
        return _toggle_measure(workspace, None)
    if workspace.form_open:
        return replace(workspace, form_open=False)
    if len(layer_selection.selected_layers(workspace)) > 1:
        return replace(workspace, selected=frozenset())
    return replace(workspace, focus=None)


def _show_all(workspace: Workspace, _: None) -> Workspace:
    view = show_all(workspace.view)
    return replace(workspace, view=replace(view, selection=selection.show_all(view.selection)))


def _rename_group(workspace: Workspace, action: Rename) -> Workspace:
    view = workspace.view
    old = view.groups[action.index].name
    renamed = change_group(view, old, lambda group: replace(group, name=action.text))
    return replace(workspace, view=renamed)


def _toggle_cards(workspace: Workspace, _: None) -> Workspace:
    """Toggle compact layer rows. The mode becomes "auto" if that gives the requested result."""
    compact = not is_compact(workspace)
    cards = "compact" if compact else "full"
    if compact != workspace.cards_fit:
        cards = "auto"
    return replace(workspace, view=replace(workspace.view, cards=cards))


def _next_value(workspace: Workspace, name: str, values: Sequence[str]) -> Workspace:
    """Set an attribute of the view to the next of `values`, cyclically."""
    changes: dict[str, Any] = {name: following(values, getattr(workspace.view, name))}
    return replace(workspace, view=replace(workspace.view, **changes))


def _set_mode(workspace: Workspace, mode: str) -> Workspace:
    """Set the view mode, or return to the splats if it is already set."""
    if mode not in VIEW_MODES:
        return workspace
    mode = ViewState.mode if mode == workspace.view.mode else mode
    return replace(workspace, view=replace(workspace.view, mode=mode))


def _next_blend(workspace: Workspace, _: None) -> Workspace:
    """Set the selected layers to the rule after that of the focused one, or else the rule of the stack."""
    if workspace.focus is None:
        return _next_value(workspace, "blend", BLENDS)
    view = workspace.view
    rule = following(BLENDS, view.layers[workspace.focus].blend or view.blend)
    return layer_selection.change_selected(workspace, lambda _, layer: replace(layer, blend=rule))


def _go_to_entry(workspace: Workspace, past: History) -> Workspace:
    if past is workspace.past:
        return workspace
    entry = past.present
    workspace = replace(workspace, past=past, snapshots=entry.snapshots, renaming=None)
    return with_layers_of(workspace, history.apply_present(workspace.view, past))


def _perform_on_timeline(workspace: Workspace, action: Action) -> Workspace:
    view, player = timeline.perform(workspace.view, workspace.player, action)
    past = history.follow_look(workspace.past, workspace.view, view)
    if loses_strengths(workspace, view):  # undo restores them: by a separate entry, or with the keys
        if action.name not in ("move_keys", "clone_keys"):
            past = history.record(past, view, workspace.snapshots)
    elif past.present.edit.layers == workspace.view.layers:
        past = history.follow_playhead(past, workspace.view, view)
    return replace(workspace, view=view, player=player, past=past)


def _restore(workspace: Workspace, index: int) -> Workspace:
    """Restore a snapshot by its index in the panel. Index 0 is the original."""
    listed = snapshots.with_original(workspace.snapshots, workspace.view)
    if not 0 <= index < len(listed):
        return workspace
    return with_layers_of(workspace, snapshots.restore(workspace.view, listed[index]))


def _name_snapshot(workspace: Workspace, action: Rename) -> Workspace:
    """Rename a snapshot, also in the compared pair."""
    index = action.index - 1
    old = workspace.snapshots
    new = snapshots.rename(workspace.snapshots, index, action.text)
    old_name = old[index].name
    new_name = new[index].name
    pair = workspace.view.pair
    pair = replace(
        pair, a=new_name if pair.a == old_name else pair.a, b=new_name if pair.b == old_name else pair.b
    )
    return replace(workspace, snapshots=new, view=replace(workspace.view, pair=pair))


def _move_snapshot(workspace: Workspace, action: MoveSnapshot) -> Workspace:
    moved = snapshots.move(workspace.snapshots, action.index - 1, action.to - 1)
    return replace(workspace, snapshots=moved)


def _choose_snapshot(workspace: Workspace, action: ChooseSnapshot) -> Workspace:
    """Put a snapshot into the compared pair."""
    return replace(workspace, view=snapshots.choose(workspace.view, action.slot, action.snapshot))


def _move_keyboard_focus(workspace: Workspace, by: float) -> Workspace:
    """Move the keyboard focus to the next or previous part of the window.

    The picture comes after the last part and before the first one.
    """
    places = ("", *PLACES)
    at = (places.index(workspace.keyboard) + int(by)) % len(places)
    return replace(workspace, keyboard=places[at], keyboard_by=int(by))


def _new_edit(workspace: Workspace, _: None) -> Workspace:
    """Open or close the form of a new edit. Its region defaults to the selection if there is one.

    Closing keeps the settings, but not the name: the next edit is another one.
    """
    if workspace.form_open:
        return replace(workspace, form=replace(workspace.form, name="", error=""), form_open=False)
    form = workspace.form
    selection = workspace.view.selection
    known = (ALL, TYPED, CHANGED, *(region.name for region in selection.regions))
    if selection.count:
        form = replace(form, region=SELECTION)
    elif form.region not in known:
        form = replace(form, region=ALL)
    return replace(workspace, form=replace(form, error=""), form_open=True, form_opening=True)


def _new_grade(workspace: Workspace, _: None) -> Workspace:
    """Open the form with a grade."""
    opened = workspace if workspace.form_open else _new_edit(workspace, None)
    grade = next(i for i, choice in enumerate(EDITORS) if choice.kind == "grade")
    return replace(opened, form=with_editor(opened.form, grade), form_opening=True)


def _toggle_clipping(workspace: Workspace, _: None) -> Workspace:
    """Mark the colors that the form's grade clips, or stop marking them. Opens the form with a grade."""
    if not workspace.form_open or workspace.form.choice.setting != "grade":
        workspace = _new_grade(workspace, None)
    return replace(workspace, form=replace(workspace.form, clipping=not workspace.form.clipping))


GLIDES = ("frame", "home", "look")
"""Names of the commands whose camera move is animated as a glide."""
ACTIONS: dict[str, Callable[[Workspace, Any], Workspace]] = {
    "focus": _focus,
    "unfocus": _close_or_unfocus,
    "toggle": _toggle,
    "hide": lambda workspace, _: layer_selection.switch_selected(workspace, "enabled"),
    "nudge": lambda workspace, by: layer_selection.nudge(workspace, by),
    "move": lambda workspace, by: layer_selection.move(workspace, int(by)),
    "solo": lambda workspace, _: layer_selection.switch_selected(workspace, "solo"),
    "show_all": _show_all,
    "lock": lambda workspace, _: layer_selection.switch_selected(workspace, "locked"),
    "fold": lambda workspace, _: change_focused(workspace, toggle_details),
    "rename": _rename,
    "remove": layer_selection.remove,
    "press_layer": layer_selection.press,
    "select_layers": layer_selection.select_layers,
    "master": lambda workspace, strength: layer_selection.set_master(workspace, strength),
    "reset": lambda workspace, _: layer_selection.reset(workspace, everything=False),
    "reset_all": lambda workspace, _: layer_selection.reset(workspace, everything=True),
    "group": layer_selection.group,
    "ungroup": layer_selection.ungroup,
    "rename_group": _rename_group,
    "search": lambda workspace, _: replace(workspace, searching=bool(workspace.view.layers)),
    "cards": _toggle_cards,
    "blend": _next_blend,
    "set_blend": lambda w, rule: layer_selection.change_selected(w, lambda _, l: replace(l, blend=rule)),
    "select_tool": _toggle_tool,
    "select_through": lambda w, _: replace(
        w, view=replace(w.view, select=replace(w.view.select, through=not w.view.select.through))
    ),
    "brush": _toggle_brush,
    "brush_mode": _switch_mode,
    "brush_weights": lambda w, _: _change_brush(w, weights=not w.view.brush.weights),
    "brush_through": lambda w, _: _change_brush(w, through=not w.view.brush.through),
    "brush_radius": _resize,
    "brush_softness": _soften,
    "paint_tool": _toggle_paint_tool,
    "pull": _start_pull,
    "measure": _toggle_measure,
    "true_length": _set_unit,
    "discard_paint": lambda w, _: replace(w, view=replace(w.view, painted=())),
    "overshoot": lambda w, _: replace(w, view=with_overshoot(w.view, not w.view.overshoot)),
    "snapshot": lambda w, _: replace(w, snapshots=snapshots.take(w.snapshots, w.view)),
    "restore": _restore,
    "forget": lambda w, at: replace(w, snapshots=snapshots.remove(w.snapshots, at - 1)),
    "name_snapshot": _name_snapshot,
    "move_snapshot": _move_snapshot,
    "choose_snapshot": _choose_snapshot,
    "undo": lambda w, _: _go_to_entry(w, history.undo(w.past)),
    "redo": lambda w, _: _go_to_entry(w, history.redo(w.past)),
    "go_to": lambda w, index: _go_to_entry(w, history.go_to(w.past, index)),
    "next_place": _move_keyboard_focus,
    "history": lambda w, _: replace(w, history=True),
    "navigate": _navigate,
    "zoom": _zoom,
    "reduced_motion": lambda w, _: replace(
        w, layout=replace(w.layout, reduced_motion=not w.layout.reduced_motion)
    ),
    "status": lambda w, _: replace(w, layout=replace(w.layout, status=not w.layout.status)),
    "histogram": _toggle_histogram,
    "fly": lambda w, _: with_camera(w, controls.toggle_fly(w.view.camera)),
    "look": _view_from,
    "view_settings": lambda w, _: replace(w, settings_opening=True),
    "grid": lambda w, _: replace(w, view=replace(w.view, grid=not w.view.grid)),
    "axes": lambda w, _: replace(w, view=replace(w.view, axes=not w.view.axes)),
    "view_mode": _set_mode,
    "next_view_mode": lambda w, _: _next_value(w, "mode", VIEW_MODES),
    "safe_frame": lambda w, _: _next_value(w, "safe_frame", FRAMES),
    "tour": lambda workspace, _: start_tour(workspace),
    "help": lambda workspace, _: replace(workspace, help=not workspace.help, help_query=""),
    "palette": lambda workspace, _: replace(workspace, palette=-1, query="", help=False),
    "before": lambda w, _: replace(w, before=not w.before),
    "beside": lambda w, _: replace(w, view=snapshots.toggle_mode(w.view, "beside")),
    "split": lambda w, _: replace(w, view=snapshots.toggle_mode(w.view, "split")),
    "difference": lambda w, _: replace(w, view=snapshots.toggle_mode(w.view, "difference")),
    "compare_snapshots": lambda w, _: (
        replace(w, view=snapshots.toggle_snapshots(w.view)) if w.snapshots else w
    ),
    "dynamic_resolution": lambda w, _: _next_value(w, "dynamic_resolution", RESOLUTION_MODES),
    "new_edit": _new_edit,
    "new_grade": _new_grade,
    "clipping": _toggle_clipping,
    "panel": lambda w, _: replace(w, view=replace(w.view, panel=not w.view.panel)),
}
"""Handlers of all other commands; each receives the workspace and the command's `argument`."""
