"""The panel: draws a workspace, returns the changed one. imgui only: no scene, no GL, no files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from imgui_bundle import imgui

from viewer.camera.up_axis import Vec3
from viewer.camera.view_camera import ViewCamera, axes, with_up
from viewer.state import history
from viewer.state.layer_selection import selected_layers
from viewer.state.recordings import obstacle
from viewer.state.view_state import AGAINST, COMPARE_MODES, MOST_AMPLIFIED, Comparison, ViewState
from viewer.state.workspace import UNSAVED, SceneFacts, Workspace, has_unsaved
from viewer.ui.context import PALETTE, Icon, UiContext
from viewer.ui.keys import shortcut
from viewer.ui.widgets import (
    choice,
    elide,
    group_digits,
    icon_button,
    is_double_clicked,
    label,
    right_edge,
    section,
    small,
    tip,
)

from . import (
    brush,
    layer_bar,
    layer_card,
    layer_cards,
    main_menu,
    new_edit_form,
    selection_section,
    snapshot_cards,
    training_cards,
)

WIDTH_PX = 300.0  # at 1×

UPS: tuple[tuple[str, Vec3], ...] = (
    ("+X", (1.0, 0.0, 0.0)),
    ("−X", (-1.0, 0.0, 0.0)),
    ("+Y", (0.0, 1.0, 0.0)),
    ("−Y", (0.0, -1.0, 0.0)),
    ("+Z", (0.0, 0.0, 1.0)),
    ("−Z", (0.0, 0.0, -1.0)),
)


def width(ui: UiContext) -> float:
    """The panel's width in window pixels."""
    return WIDTH_PX * ui.scale


def draw(
    work: Workspace,
    facts: SceneFacts,
    textures: Sequence[int],
    preview: tuple[str, bool],
    recent: Sequence[Path],
    reveal: bool,
    ui: UiContext,
    actions: list[str],
) -> Workspace:
    """Draw the panel along the right edge of the display, between `imgui.new_frame` and `imgui.render`.

    Args:
        work: what it shows and changes
        facts: of the open scene
        textures: GL names of the snapshots' pictures, that of the original first; 0 before one is drawn
        preview: what is said of the picture of a new edit, and whether it failed
        recent: files opened before, the last one first
        reveal: scroll to the focused layer
        ui: fonts and scale
        actions: takes those that were asked for, see `perform`
    """
    display = imgui.get_io().display_size
    imgui.set_next_window_pos(imgui.ImVec2(display.x - width(ui), 0.0))
    imgui.set_next_window_size(imgui.ImVec2(width(ui), display.y))
    imgui.begin("panel", None, _FLAGS)
    _title(work, facts, recent, ui, actions)
    footer = imgui.get_frame_height() + imgui.get_style().item_spacing.y * 2
    room = imgui.get_content_region_avail().y - footer - layer_cards.HEADING_PX * ui.scale
    work = replace(work, cards_fit=len(work.view.layers) * layer_card.CARD_PX * ui.scale <= room)
    selected = selected_layers(work)
    _begin_body(footer + layer_bar.selection_height(selected, ui))
    work = replace(work, view=layer_cards.heading(work.view, work.form_open, ui, actions))
    work = new_edit_form.draw(work, facts.count, preview, ui, actions)
    training_cards.draw(work.jobs, ui, actions)
    training_cards.draw_deliveries(work.deliveries, ui, actions)
    work = layer_cards.draw(work, facts.rows, reveal, ui, actions)
    view, pointed = work.view, work.pointed
    if view.brush.active:
        view = brush.draw(view, work.focus, ui, actions)
    view, under = selection_section.draw(view, ui, actions)
    pointed = pointed or under or selection_section.draw_regions(view.selection.regions, ui, actions)
    view = _view(view, obstacle(facts.recordings), len(textures) > 1, ui, actions)
    work = replace(work, view=view, pointed=pointed)
    snapshot_cards.draw(work, facts.rows, textures, ui, actions)
    _end_body()
    layer_bar.selection(work.view, selected, ui, actions)
    _footer(work, ui, actions)
    imgui.end()
    return work


def _begin_body(footer: float) -> None:
    """What scrolls; its scrollbar stands in the panel's margin, so that nothing moves when one is needed."""
    overflows = imgui.get_state_storage().get_bool(imgui.get_id("overflows"))
    clear = imgui.ImVec4(0.0, 0.0, 0.0, 0.0)
    slots = (imgui.Col_.scrollbar_grab, imgui.Col_.scrollbar_grab_hovered, imgui.Col_.scrollbar_grab_active)
    for slot in () if overflows else slots:
        imgui.push_style_color(slot, clear)
    flags = imgui.WindowFlags_
    wide = imgui.get_content_region_avail().x + imgui.get_style().scrollbar_size
    imgui.begin_child(
        "body",
        imgui.ImVec2(wide, -footer),
        0,
        flags.no_nav.value | flags.always_vertical_scrollbar.value,
    )
    if not overflows:
        imgui.pop_style_color(len(slots))


def _end_body() -> None:
    # the content's own height: imgui's scroll range is a frame behind it
    overflows = imgui.get_cursor_pos_y() - imgui.get_style().item_spacing.y > imgui.get_window_height()
    imgui.end_child()
    imgui.get_state_storage().set_bool(imgui.get_id("overflows"), overflows)


def _title(
    work: Workspace, facts: SceneFacts, recent: Sequence[Path], ui: UiContext, actions: list[str]
) -> None:
    """The scene's name, after a dot where there are unsaved changes, its size, and the menu at the right."""
    at, side = imgui.get_cursor_pos(), imgui.get_frame_height()
    imgui.push_font(ui.fonts.bold, 0.0)
    room = imgui.get_content_region_avail().x
    imgui.text(elide(UNSAVED * has_unsaved(work) + facts.title, room - side))
    imgui.pop_font()
    small(f"{group_digits(facts.count)} splats", PALETTE.dim, room - side)
    below = imgui.get_cursor_pos()
    imgui.set_cursor_pos(imgui.ImVec2(at.x + room - side, at.y - 2.0 * ui.scale))
    main_menu.button(work, recent, ui, actions)
    imgui.set_cursor_pos(below)
    imgui.dummy(imgui.ImVec2(0.0, 2.0 * ui.scale))


def _view(state: ViewState, unrecorded: str, kept: bool, ui: UiContext, actions: list[str]) -> ViewState:
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    section("View", ui)
    column = 82.0 * ui.scale
    camera = state.camera
    label("Navigate", column)
    mode = choice("mode", ("Orbit", "Fly"), ("orbit", "fly").index(camera.mode), ui)
    tip("Orbit around a pivot, or fly", "fly")
    if mode is not None:
        camera = replace(camera, mode=("orbit", "fly")[mode])
    label("Up axis", column)
    ups = (*UPS, ("View", axes(camera).up))
    current = next((i for i, (_, up) in enumerate(UPS) if up == camera.up), len(UPS))
    chosen = choice("up", tuple(name for name, _ in ups), current, ui)
    tip("Up axis of the scene. View: use the current view's up direction")
    if chosen is not None:
        camera = with_up(camera, ups[chosen][1])
    label("FOV", column)
    imgui.set_next_item_width(-1.0)
    changed, fov_y = imgui.slider_float("##fov", camera.fov_y, 10.0, 110.0, "%.0f°", _ALWAYS_CLAMP)
    if is_double_clicked():
        changed, fov_y = True, ViewCamera.fov_y
    camera = replace(camera, fov_y=fov_y) if changed else camera  # unchanged, imgui still rounds to float32
    tip(f"Vertical field of view. Double-click: reset to {ViewCamera.fov_y:g}°")
    label("Background", column)
    picker = imgui.ColorEditFlags_.no_inputs.value | imgui.ColorEditFlags_.no_alpha.value
    changed, (red, green, blue) = imgui.color_edit3("##background", list(state.background), picker)
    background = (red, green, blue) if changed else state.background
    comparison = _comparison(state.compare, unrecorded, kept, column, ui)
    label("Show", column)
    half = (imgui.get_content_region_avail().x - 6.0 * ui.scale) / 2
    if imgui.button(f"{Icon.FRAME}  Frame", imgui.ImVec2(half, 0.0)):
        actions.append("frame")
    tip("Frame the selection, the focused layer, or the scene", "frame")
    imgui.same_line(0.0, 6.0 * ui.scale)
    if imgui.button(f"{Icon.HOME}  Home", imgui.ImVec2(half, 0.0)):
        actions.append("home")
    tip("Reset the view", "home")
    return replace(state, camera=camera, background=background, compare=comparison)


def _comparison(shown: Comparison, unrecorded: str, kept: bool, column: float, ui: UiContext) -> Comparison:
    """Off, beside each other or subtracted; with the original, what was recorded, or two snapshots.

    `unrecorded`: why nothing is recorded; `kept`: whether there are snapshots.
    """
    label("Compare", column)
    chosen = choice("compare", ("Off", "Side", "Split", "Diff"), COMPARE_MODES.index(shown.mode), ui)
    beside, split = shortcut("beside"), shortcut("split")
    tip(f"Side by side ({beside}), split view ({split}), or amplified difference", "difference")
    if chosen is not None:
        shown = replace(shown, mode=COMPARE_MODES[chosen])
    if shown.mode == "off" and not kept:
        return shown
    label("Against", column)  # also while nothing is compared where there are snapshots: theirs lie below it
    off = {i for i, no in ((1, unrecorded), (2, not kept)) if no}
    against = None if shown.mode == "off" else AGAINST.index(shown.against)
    chosen = choice("against", ("Original", "Recorded", "A | B"), 0 if against in off else against, ui, off)
    recorded, pair = shortcut("against"), shortcut("compare_snapshots")
    tip(
        f"Compare with the original, with what training recorded ({recorded}), or snapshot A with B ({pair})"
        + (f"\nNo recording: {unrecorded}" if unrecorded else "")
    )
    if chosen is not None:
        mode = "split" if shown.mode == "off" else shown.mode
        shown = replace(shown, mode=mode, against=AGAINST[chosen])
    if shown.mode == "difference":
        label("Amplify", column)
        imgui.set_next_item_width(-1.0)
        changed, times = imgui.slider_float(
            "##amplify", shown.amplify, 1.0, MOST_AMPLIFIED, "× %.0f", _LOGARITHMIC
        )
        if is_double_clicked():
            changed, times = True, Comparison.amplify
        shown = replace(shown, amplify=float(round(times))) if changed else shown
        tip(f"Gain of the difference. Double-click: reset to × {Comparison.amplify:g}")
    return shown


_FLAGS = (
    imgui.WindowFlags_.no_decoration.value
    | imgui.WindowFlags_.no_move.value
    | imgui.WindowFlags_.no_saved_settings.value
    | imgui.WindowFlags_.no_bring_to_front_on_focus.value
    | imgui.WindowFlags_.no_nav.value
    | imgui.WindowFlags_.no_scroll_with_mouse.value
)
_ALWAYS_CLAMP = imgui.SliderFlags_.always_clamp.value
_LOGARITHMIC = _ALWAYS_CLAMP | imgui.SliderFlags_.logarithmic.value


def _footer(work: Workspace, ui: UiContext, actions: list[str]) -> None:
    imgui.separator()
    right = right_edge()
    for action, icon, change in (
        ("undo", Icon.UNDO, history.next_undo(work.past)),
        ("redo", Icon.REDO, history.next_redo(work.past)),
    ):
        imgui.begin_disabled(not change)
        if icon_button(action, icon, ui):
            actions.append(action)
        imgui.end_disabled()
        tip(f"{action.capitalize()}{change and ': '}{change}", action)
        imgui.same_line()
    if work.view.layers and brush.toggle(work.view, ui):
        actions.append("brush")
    side, gap = imgui.get_frame_height(), 6.0 * ui.scale
    imgui.same_line(right - 3 * side - 2 * gap)
    for action, icon, help_ in (
        ("timeline", Icon.FILM, "Timeline: animate the camera and the strengths"),
        ("picture", Icon.PICTURE, "Save the image as PNG"),
        ("help", Icon.HELP, "Keyboard and mouse shortcuts"),
    ):
        if icon_button(action, icon, ui):
            actions.append(action)
        tip(help_, action)
        imgui.same_line(0.0, gap)
