"""The panel: draws a workspace, returns the changed one. imgui only: no scene, no GL, no files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from imgui_bundle import imgui

from progdf.terminal import escape_text
from viewer.camera.view_camera import Vec3, ViewCamera, axes, with_up
from viewer.state import history
from viewer.state.facts import obstacle
from viewer.state.layer_selection import selected_layers
from viewer.state.view_state import AGAINST, COMPARE_MODES, MOST_AMPLIFIED, Comparison, ViewState
from viewer.state.workspace import UNSAVED, PreviewState, SceneFacts, Workspace, has_unsaved, is_compact
from viewer.ui.context import BEHIND, FIXED, PALETTE, Icon, UiContext
from viewer.ui.keys import shortcut
from viewer.ui.widgets import (
    choice,
    choice_row,
    elide,
    icon_button,
    is_double_clicked,
    label,
    menu,
    right_edge,
    section,
    small,
    tip,
    with_added,
)

from . import card, cards, new_edit_form, snapshot_cards, tools, training_cards

NAME = "main menu"
MOST_PX = 360.0
_FILES = (("Open…", "open"),)
_SAVES = (("Save", "save"), ("Save as…", "save_as"))
_MAKES = (
    ("New edit", "new_edit"),
    ("Take this view", "take_view"),
    ("Hide strays", "hide_strays"),
    ("Export .ply…", "export"),
    ("Export web page…", "export_page"),
    ("Render picture…", "render_picture"),
    ("Render film…", "render_film"),
)
_VIEWS = (
    ("Front", "look:front"),
    ("Back", "look:back"),
    ("Right", "look:right"),
    ("Left", "look:left"),
    ("Top", "look:top"),
    ("Bottom", "look:bottom"),
)
_LAYERS = (
    ("Select all", "select_layers"),
    ("Search", "search"),
    ("Group", "group"),
    ("Ungroup", "ungroup"),
    ("Copy values", "copy_values"),
    ("Paste values", "paste_values"),
    ("Reset", "reset"),
    ("Reset all", "reset_all"),
)
_FRAMES = (("Frame", "frame"), ("Home", "home"))
_HELP = (("Shortcuts", "help"), ("About", "about"), ("Quit", "quit"))


def _menu_button(work: Workspace, recent: Sequence[Path], ui: UiContext, actions: list[str]) -> None:
    """The button at the right of the present line, and its menu while it is open.

    `recent`: files opened before, the last one first.
    """
    if icon_button("menu", Icon.BARS, ui):
        imgui.open_popup(NAME)
    tip("Menu")
    with menu(NAME, ui) as is_open:
        if is_open:
            actions += _items(_FILES)
            actions += _recent(recent, ui)
            actions += _items(_SAVES)
            imgui.separator()
            actions += _items(_MAKES)
            imgui.separator()
            actions += _view_menu(work.view)
            actions += _layers_menu(work)
            imgui.separator()
            actions += _items(_HELP)


def _items(items: Sequence[tuple[str, str]]) -> list[str]:
    return [action for name, action in items if imgui.menu_item(name, shortcut(action), False)[0]]


def _view_menu(view: ViewState) -> list[str]:
    actions: list[str] = []
    if imgui.begin_menu("View"):
        actions += _items(_VIEWS)
        imgui.separator()
        actions += _items(_FRAMES)
        imgui.separator()
        for name, action, on in (("Ground grid", "grid", view.grid), ("Axes", "axes", view.axes)):
            actions += [action] * bool(imgui.menu_item(name, shortcut(action), on)[0])
        imgui.end_menu()
    return actions


def _layers_menu(work: Workspace) -> list[str]:
    actions: list[str] = []
    if imgui.begin_menu("Layers", bool(work.view.layers)):
        actions += _items(_LAYERS)
        imgui.separator()
        actions += ["cards"] * bool(imgui.menu_item("Compact rows", shortcut("cards"), is_compact(work))[0])
        imgui.end_menu()
    return actions


def _recent(recent: Sequence[Path], ui: UiContext) -> list[str]:
    actions: list[str] = []
    if imgui.begin_menu("Recent", bool(recent)):
        for i, path in enumerate(recent):
            name = elide(escape_text(path.name), MOST_PX * ui.scale)
            if imgui.menu_item(f"{name}##{i}", "", False)[0]:
                actions.append(f"open_file:{path}")
            tip(escape_text(str(path)))
        imgui.end_menu()
    return actions


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
    preview: PreviewState,
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
        preview: what is said of the picture of a new edit
        recent: files opened before, the last one first
        reveal: scroll to the focused layer
        ui: fonts and scale
        actions: takes those that were asked for, see `perform`
    """
    display = imgui.get_io().display_size
    imgui.set_next_window_pos(imgui.ImVec2(display.x - width(ui), 0.0))
    imgui.set_next_window_size(imgui.ImVec2(width(ui), display.y))
    imgui.begin("panel", None, FIXED | BEHIND | imgui.WindowFlags_.no_scroll_with_mouse.value)
    _title(work, facts, recent, ui, actions)
    footer = imgui.get_frame_height() + imgui.get_style().item_spacing.y * 2
    room = imgui.get_content_region_avail().y - footer - cards.HEADING_PX * ui.scale
    work = replace(work, cards_fit=len(work.view.layers) * card.CARD_PX * ui.scale <= room)
    selected = selected_layers(work)
    _begin_body(footer + cards.selection_height(selected, ui))
    work = replace(work, view=cards.heading(work.view, work.form_open, ui, actions))
    work = new_edit_form.draw(work, facts.count, preview, ui, actions)
    training_cards.draw(work.jobs, ui, actions)
    work = cards.draw(work, facts.rows, reveal, ui, actions)
    view, pointed = work.view, work.pointed
    if view.brush.active:
        view = tools.draw_brush(view, work.focus, ui, actions)
    view, under = tools.draw(view, ui, actions)
    pointed = pointed or under or tools.draw_regions(view.selection.regions, ui, actions)
    view = _view(view, obstacle(facts.recordings), len(textures) > 1, ui, actions)
    work = replace(work, view=view, pointed=pointed)
    snapshot_cards.draw(work, facts.rows, textures, ui, actions)
    _end_body()
    cards.draw_selection(work.view, selected, ui, actions)
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
    small(f"{with_added(facts.count, facts.added)} splats", PALETTE.dim, room - side)
    below = imgui.get_cursor_pos()
    imgui.set_cursor_pos(imgui.ImVec2(at.x + room - side, at.y - 2.0 * ui.scale))
    _menu_button(work, recent, ui, actions)
    imgui.set_cursor_pos(below)
    imgui.dummy(imgui.ImVec2(0.0, 2.0 * ui.scale))


def _view(
    state: ViewState, unrecorded: str, has_snapshots: bool, ui: UiContext, actions: list[str]
) -> ViewState:
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    section("View", ui)
    column = 82.0 * ui.scale
    camera = state.camera
    modes, help_ = {"orbit": "Orbit", "fly": "Fly"}, "Orbit around a pivot, or fly"
    camera = replace(camera, mode=choice_row("Navigate", modes, camera.mode, column, ui, help_, "fly"))
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
    comparison = _comparison(state.compare, unrecorded, has_snapshots, column, ui)
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


def _comparison(
    compare: Comparison, unrecorded: str, has_snapshots: bool, column: float, ui: UiContext
) -> Comparison:
    """Off, beside each other or subtracted; with the original, what was recorded, or two snapshots.

    `unrecorded`: why nothing is recorded; `has_snapshots`: whether there are snapshots.
    """
    label("Compare", column)
    chosen = choice("compare", ("Off", "Side", "Split", "Diff"), COMPARE_MODES.index(compare.mode), ui)
    beside, split = shortcut("beside"), shortcut("split")
    tip(f"Side by side ({beside}), split view ({split}), or amplified difference", "difference")
    if chosen is not None:
        compare = replace(compare, mode=COMPARE_MODES[chosen])
    if compare.mode == "off" and not has_snapshots:
        return compare
    label("Against", column)  # also while nothing is compared where there are snapshots: theirs lie below it
    off = {i for i, no in ((1, unrecorded), (2, not has_snapshots)) if no}
    against = None if compare.mode == "off" else AGAINST.index(compare.against)
    chosen = choice("against", ("Original", "Recorded", "A | B"), 0 if against in off else against, ui, off)
    recorded, pair = shortcut("against"), shortcut("compare_snapshots")
    tip(
        f"Compare with the original, with what training recorded ({recorded}), or snapshot A with B ({pair})"
        + (f"\nNo recording: {unrecorded}" if unrecorded else "")
    )
    if chosen is not None:
        mode = "split" if compare.mode == "off" else compare.mode
        compare = replace(compare, mode=mode, against=AGAINST[chosen])
    if compare.mode == "difference":
        label("Amplify", column)
        imgui.set_next_item_width(-1.0)
        changed, times = imgui.slider_float(
            "##amplify", compare.amplify, 1.0, MOST_AMPLIFIED, "× %.0f", _LOGARITHMIC
        )
        if is_double_clicked():
            changed, times = True, Comparison.amplify
        compare = replace(compare, amplify=float(round(times))) if changed else compare
        tip(f"Gain of the difference. Double-click: reset to × {Comparison.amplify:g}")
    return compare


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
    if work.view.layers and tools.brush_button(work.view, ui):
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
