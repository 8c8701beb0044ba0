"""The panel: draws a state, returns the changed state. imgui only: no scene, no GL, no files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from imgui_bundle import imgui

from viewer.camera import view_camera as turntable
from viewer.camera.up_axis import Vec3
from viewer.camera.view_camera import ViewCamera
from viewer.jobs.job_queue import Job
from viewer.jobs.training import NewEdit
from viewer.state.layer_facts import LayerRow
from viewer.state.view_state import AGAINST, COMPARE_MODES, MOST_AMPLIFIED, Comparison, ViewState, cards_shown
from viewer.state.workspace import Pointed
from viewer.ui.context import PALETTE, Icon, UiContext
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
from .new_edit_form import FormInput
from .snapshot_cards import SnapshotCard, SnapshotSlider

WIDTH_PX = 300.0  # at 1×

UPS: tuple[tuple[str, Vec3], ...] = (
    ("+X", (1.0, 0.0, 0.0)),
    ("−X", (-1.0, 0.0, 0.0)),
    ("+Y", (0.0, 1.0, 0.0)),
    ("−Y", (0.0, -1.0, 0.0)),
    ("+Z", (0.0, 0.0, 1.0)),
    ("−Z", (0.0, 0.0, -1.0)),
)


@dataclass(frozen=True)
class PanelInput:
    """What the panel shows besides the state.

    Args:
        title: the scene's name, after a dot where there are unsaved changes
        count: Gaussians in the scene
        rows: one per .gdf, indexed by `LayerState.gdf`
        focus: the focused layer, an index into `state.layers`, or None
        undo, redo: what they would take and bring back, "" for nothing
        reveal: scroll to the focused layer
        snapshots: the original and what was kept
        active_slider: which of `layers.SLIDERS` of the focused layer the arrow keys move
        renaming: the layer whose name is being typed, or None
        unrecorded: why there is nothing recorded to compare with, "" where there is
        form: of a new edit; None while it is closed
        form_input: what that form shows
        jobs: what is being trained, exported and rendered
        recent: files opened before, the last one first
        selected, search, searching: as in `Cards`
        snapshot_slider: between two snapshots
        cards_fit: as in the last frame's `PanelResult`
    """

    title: str
    count: int
    rows: Sequence[LayerRow]
    focus: int | None = None
    undo: str = ""
    redo: str = ""
    reveal: bool = False
    active_slider: str = "strength"
    renaming: int | None = None
    snapshots: tuple[SnapshotCard, ...] = ()
    unrecorded: str = ""
    form: NewEdit | None = None
    form_input: FormInput = FormInput()
    jobs: Sequence[Job] = ()
    recent: Sequence[Path] = ()
    selected: frozenset[int] = frozenset()
    search: str = ""
    searching: bool = False
    snapshot_slider: SnapshotSlider = SnapshotSlider()
    cards_fit: bool = True


@dataclass(frozen=True)
class PanelResult:
    """The changed state, the focused layer, the one being renamed, and the actions asked for.

    `overlap`: the layer of which to show what it shares with the others, while the mouse rests on that line;
    `pointed`: what else it rests on that the picture shows; `search`: what layers are filtered by;
    `cards_fit`: whether there is room for a whole card of each layer.
    Actions are named as in `controls.KEYS`.
    """

    state: ViewState
    focus: int | None
    actions: tuple[str, ...] = ()
    renaming: int | None = None
    overlap: int | None = None
    pointed: Pointed | None = None
    form: NewEdit | None = None
    search: str = ""
    cards_fit: bool = True


def width(ui: UiContext) -> float:
    """The panel's width in window pixels."""
    return WIDTH_PX * ui.scale


def draw(state: ViewState, shown: PanelInput, ui: UiContext) -> PanelResult:
    """Draw the panel along the right edge of the display, between `imgui.new_frame` and `imgui.render`."""
    display = imgui.get_io().display_size
    imgui.set_next_window_pos(imgui.ImVec2(display.x - width(ui), 0.0))
    imgui.set_next_window_size(imgui.ImVec2(width(ui), display.y))
    flags = imgui.WindowFlags_
    imgui.begin(
        "panel",
        None,
        flags.no_decoration.value
        | flags.no_move.value
        | flags.no_saved_settings.value
        | flags.no_bring_to_front_on_focus.value
        | flags.no_nav.value
        | flags.no_scroll_with_mouse.value,
    )
    actions: list[str] = []
    actions += _title(state, shown, ui)
    footer = imgui.get_frame_height() + imgui.get_style().item_spacing.y * 2
    chosen = [i for i, l in enumerate(state.layers) if i == shown.focus or l.gdf in shown.selected]
    room = imgui.get_content_region_avail().y - footer - layer_cards.HEADING_PX * ui.scale
    fit = len(state.layers) * layer_card.CARD_PX * ui.scale <= room
    _begin_body(footer + layer_bar.selection_height(chosen, ui))
    state, asked = layer_cards.heading(state, shown.form is not None, ui)
    actions += [asked] if asked else []
    form = shown.form
    if form is not None:
        form, asked = new_edit_form.draw(form, shown.form_input, ui)
        actions += [asked] if asked else []
    actions += training_cards.draw(shown.jobs, ui)
    cards = layer_card.Cards(
        shown.rows,
        shown.focus,
        shown.reveal,
        shown.active_slider,
        shown.renaming,
        shown.selected,
        cards_shown(state, fit) == "compact",
        shown.search,
        shown.searching,
    )
    expected = bool(shown.jobs) or form is not None
    drawn = layer_cards.draw(state, cards, ui, expected)
    state, focus = drawn.state, drawn.focus
    actions += drawn.actions
    if state.brush.active:
        state, asked = brush.section(state, focus, ui)
        actions += [asked] if asked else []
    state, selected = selection_section.draw(state, ui, actions)
    region = selection_section.draw_regions(state.selection.regions, ui, actions)
    state = _view(state, shown.unrecorded, len(shown.snapshots) > 1, ui, actions)
    snapshot_cards.draw(shown.snapshots, shown.snapshot_slider, ui, actions)
    _end_body()
    layer_bar.selection(state, chosen, ui, actions)
    _footer(state, shown, ui, actions)
    imgui.end()
    pointed = drawn.pointed or selected or region
    return PanelResult(
        state, focus, tuple(actions), drawn.renaming, drawn.overlap, pointed, form, drawn.search, fit
    )


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


def _title(state: ViewState, shown: PanelInput, ui: UiContext) -> list[str]:
    """The scene's name and size, and the menu at the right of both; what was chosen there."""
    at, side = imgui.get_cursor_pos(), imgui.get_frame_height()
    imgui.push_font(ui.fonts.bold, 0.0)
    room = imgui.get_content_region_avail().x
    imgui.text(elide(shown.title, room - side))
    imgui.pop_font()
    small(f"{group_digits(shown.count)} splats", PALETTE.dim, room - side)
    below, compact = imgui.get_cursor_pos(), cards_shown(state, shown.cards_fit) == "compact"
    imgui.set_cursor_pos(imgui.ImVec2(at.x + room - side, at.y - 2.0 * ui.scale))
    actions = main_menu.button(shown.recent, state, compact, ui)
    imgui.set_cursor_pos(below)
    imgui.dummy(imgui.ImVec2(0.0, 2.0 * ui.scale))
    return actions


def _view(state: ViewState, unrecorded: str, kept: bool, ui: UiContext, actions: list[str]) -> ViewState:
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    section("View", ui)
    column = 82.0 * ui.scale
    camera = state.camera
    label("Navigate", column)
    mode = choice("mode", ("Orbit", "Fly"), ("orbit", "fly").index(camera.mode), ui)
    tip("Orbit around a pivot, or fly (V)")
    if mode is not None:
        camera = replace(camera, mode=("orbit", "fly")[mode])
    label("Up axis", column)
    ups = (*UPS, ("View", turntable.axes(camera).up))
    current = next((i for i, (_, up) in enumerate(UPS) if up == camera.up), len(UPS))
    chosen = choice("up", tuple(name for name, _ in ups), current, ui)
    tip("Up axis of the scene. View: use the current view's up direction")
    if chosen is not None:
        camera = turntable.with_up(camera, ups[chosen][1])
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
    tip("Frame the selection, the focused layer, or the scene (F)")
    imgui.same_line(0.0, 6.0 * ui.scale)
    if imgui.button(f"{Icon.HOME}  Home", imgui.ImVec2(half, 0.0)):
        actions.append("home")
    tip("Reset the view (Shift+F)")
    return replace(state, camera=camera, background=background, compare=comparison)


def _comparison(shown: Comparison, unrecorded: str, kept: bool, column: float, ui: UiContext) -> Comparison:
    """Off, beside each other or subtracted; with the original, what was recorded, or two snapshots.

    `unrecorded`: why nothing is recorded; `kept`: whether there are snapshots.
    """
    label("Compare", column)
    chosen = choice("compare", ("Off", "Side", "Split", "Diff"), COMPARE_MODES.index(shown.mode), ui)
    tip("Side by side (Y), split view (Shift+Y), or amplified difference (D)")
    if chosen is not None:
        shown = replace(shown, mode=COMPARE_MODES[chosen])
    if shown.mode == "off" and not kept:
        return shown
    label("Against", column)  # also while nothing is compared where there are snapshots: theirs lie below it
    off = {i for i, no in ((1, unrecorded), (2, not kept)) if no}
    against = None if shown.mode == "off" else AGAINST.index(shown.against)
    chosen = choice("against", ("Original", "Recorded", "A | B"), 0 if against in off else against, ui, off)
    told = f"\nNo recording: {unrecorded}" if unrecorded else ""
    tip(
        "Compare with the original, with what training recorded (Alt+Y), or snapshot A with B (Shift+F3)"
        + told
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


_ALWAYS_CLAMP = imgui.SliderFlags_.always_clamp.value
_LOGARITHMIC = _ALWAYS_CLAMP | imgui.SliderFlags_.logarithmic.value


def _footer(state: ViewState, shown: PanelInput, ui: UiContext, actions: list[str]) -> None:
    imgui.separator()
    right = right_edge()
    for action, icon, key, change in (
        ("undo", Icon.UNDO, "Ctrl+Z", shown.undo),
        ("redo", Icon.REDO, "Ctrl+Shift+Z", shown.redo),
    ):
        imgui.begin_disabled(not change)
        if icon_button(action, icon, ui):
            actions.append(action)
        imgui.end_disabled()
        tip(f"{action.capitalize()}{change and ': '}{change} ({key})")
        imgui.same_line()
    if state.layers and brush.toggle(state, ui):
        actions.append("brush")
    side = imgui.get_frame_height()
    imgui.same_line(right - 3 * side - 12.0 * ui.scale)
    if icon_button("timeline", Icon.FILM, ui):
        actions.append("timeline")
    tip("Timeline: animate the camera and the strengths (T)")
    imgui.same_line(0.0, 6.0 * ui.scale)
    if icon_button("picture", Icon.PICTURE, ui):
        actions.append("picture")
    tip("Save the image as PNG (F2)")
    imgui.same_line(0.0, 6.0 * ui.scale)
    if icon_button("help", Icon.HELP, ui):
        actions.append("help")
    tip("Keyboard and mouse shortcuts (F1)")
