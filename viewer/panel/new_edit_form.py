"""Form of a new edit: region, editor with its settings, preview, and the Train button."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from imgui_bundle import imgui, imgui_ctx

from viewer.state.commands import Action, Plain
from viewer.state.forms import (
    ALL,
    BEST_STYLES,
    CHANGED,
    EDITORS,
    SELECTION,
    SHEET_COLUMNS,
    SHEET_PX,
    STYLE_ORDER,
    TYPED,
    NewEdit,
    missing_package,
    with_editor,
)
from viewer.state.selection import SelectionState
from viewer.state.transient import PreviewState
from viewer.state.workspace import Workspace
from viewer.ui.context import HALF_GAP_PX, PALETTE, Icon, UiContext, u32
from viewer.ui.keys import COMMANDS, shortcut
from viewer.ui.widgets import (
    accent_button,
    card,
    choice_row,
    drop_down,
    elide,
    group_digits,
    icon_button,
    inert,
    label,
    right_edge,
    small,
    tip,
    value_slider,
    wrapped_text,
)

from . import grade_form

COLUMN_PX = 90.0  # start of the control in a row, at 1×
_NEAR_COLORS = {"close": PALETTE.success, "roughly": PALETTE.warning, "far": PALETTE.error}  # of the estimate


def draw(work: Workspace, count: int, ui: UiContext, actions: list[Action]) -> Workspace:
    """Draw the form if it is open. Tab moves through it, Ctrl+Enter trains, Escape closes it.

    Args:
        count: number of Gaussians in the scene
    """
    if not work.form_open:
        return work
    with card(_NAME, PALETTE.card_focused, ui, nav=True):
        storage = imgui.get_state_storage()
        listed = imgui.get_id("a list is open")
        # an open list handles Enter and Escape itself
        mine = imgui.is_window_focused() and not storage.get_bool(listed)
        closes = mine and imgui.is_key_pressed(imgui.Key.escape, False)
        asks = work.dialog is not None or storage.get_bool(listed)
        trains = not asks and imgui.get_io().key_ctrl and imgui.is_key_pressed(imgui.Key.enter, False)
        if closes:  # skip the fields, which would undo the typing
            actions.append(Plain("new_edit"))
        else:
            form, action = _content(work, count, ui, actions)
            if trains:
                action = "train"
            if action:
                actions.append(Plain(action))
            work = replace(work, form=form, form_opening=False)
        storage.set_bool(listed, imgui.is_popup_open("", imgui.PopupFlags_.any_popup.value))
    return work


_NAME = "new edit"
TRAIN_KEYS = "Ctrl+Enter"
"""Chord of the Train button while the form is open."""


def has_keyboard() -> bool:
    """Return whether the form has the keyboard: it was opened or clicked last."""
    window = imgui.get_current_context().nav_window
    return window is not None and window.was_active and f"/{_NAME}_" in window.name


def _content(work: Workspace, count: int, ui: UiContext, actions: list[Action]) -> tuple[NewEdit, str]:
    """Draw the form; return the changed form and the requested action.

    The action is "train", "paint_over", "new_edit" to close the form, or "" for none.
    """
    form = work.form
    preview = work.transient.preview
    selection = work.view.selection
    action = ""
    right = right_edge()
    with imgui_ctx.push_font(ui.fonts.bold, 0.0):
        imgui.align_text_to_frame_padding()
        imgui.text("New edit")
    imgui.same_line(right - imgui.get_frame_height())
    if icon_button("close form", Icon.CLOSE, ui, dim=True):
        action = "new_edit"
    tip(f"Close ({shortcut('new_edit')}). Training continues")
    column = COLUMN_PX * ui.scale
    # the name is below the window's edge here, and scrolling to it would hide histogram and looks
    focuses_name = form.choice.setting != "grade"
    if work.form_opening and not focuses_name:
        imgui.set_keyboard_focus_here()
    form = _region(form, selection, count, column, ui)
    form, action = _editor(form, action, column, ui)
    if form.choice.setting == "grade":
        scope = work.transient.scope
        if preview.failed:
            scope = scope._replace(note=scope.note or "The colors cannot be measured")
        form = grade_form.draw(form, scope, work.transient.shelf, column, ui, actions)
    else:
        form = _settings(form, preview, column, ui)
    if form.choice.has_anchor:
        if replace(form, asks=0, anchor="") != replace(work.form, asks=0, anchor=""):
            form = replace(form, asks=0, anchor="")  # the picture belonged to other settings
        form, requested = _anchor(form, preview, column)
        action = action or requested
    if work.form_opening and focuses_name:
        imgui.set_keyboard_focus_here()
    form = replace(form, name=_text_row("Name", form.suggested_name, form.name, column))
    tip("Name of the layer and of its file")
    qualities = {True: "Draft", False: "Full"}
    help_ = "A draft takes a third of the time"
    form = replace(form, quick=choice_row("Quality", qualities, form.quick, column, ui, help_))
    form = _preview(form, preview, column, ui)
    error = form.error or missing_package(form.choice)
    if error:
        wrapped_text(error, PALETTE.error)
    with inert(bool(form.obstacle)):
        if accent_button(f"{Icon.TRAIN}  Train", imgui.ImVec2(-1.0, 0.0), TRAIN_KEYS):
            action = "train"
    tip(form.obstacle or f"Train the edit; it becomes a layer with a slider. {_effort(form)}")
    return form, action


def _region_title(region: str, selection: SelectionState, count: int) -> str:
    """Return a region's title in the list, with the number of its Gaussians."""
    sizes = {known.name: known.count for known in selection.regions}
    match region:
        case "all":
            return f"Whole scene  ·  {group_digits(count)}"
        case "selection":
            return f"Selection  ·  {group_digits(selection.count)}"
        case "changed":
            return "Where pictures differ"
        case "typed":
            return "Custom…"
    return f"{region}  ·  {group_digits(sizes.get(region, 0))}"


def _region(form: NewEdit, selection: SelectionState, count: int, column: float, ui: UiContext) -> NewEdit:
    label("Region", column)
    imgui.set_next_item_width(-1.0)
    room = imgui.get_content_region_avail().x - 2 * imgui.get_frame_height()
    offered = []
    if form.choice.kind == "pictures":
        offered.append(CHANGED)
    if selection.count:
        offered.append(SELECTION)
    offered += [*(region.name for region in selection.regions), ALL, TYPED]
    titles = [_region_title(region, selection, count) for region in offered]
    current = offered.index(form.region) if form.region in offered else None
    title = _region_title(form.region, selection, count)
    if imgui.calc_text_size(title).x > room:  # a cut number would be read as another one
        title = elide(title.partition("  ·  ")[0], room)
    pressed = drop_down("##region", title, titles, current, ui, "Region that the edit may change")
    form = form if pressed is None else replace(form, region=offered[pressed], error="")
    if form.region == TYPED:
        form = replace(form, typed_region=_text_row("", "sphere:0,0,0,1", form.typed_region, column))
        tip("labels:FILE.npy:ID, box:…, sphere:X,Y,Z,RADIUS, file:ROWS.npy; combine with + and -")
    return form


def _editor(form: NewEdit, action: str, column: float, ui: UiContext) -> tuple[NewEdit, str]:
    """Draw the list of editors. Its first entry opens this view in another program ("paint_view")."""
    label("Editor", column)
    imgui.set_next_item_width(-1.0)
    missing = ["", *map(missing_package, EDITORS)]
    first = COMMANDS["paint_view"]
    titles = [first.name]
    helps = [first.help]
    for editor in EDITORS:
        titles.append(editor.title)
        helps.append(editor.help)
    lines = [reason or help_ for reason, help_ in zip(missing, helps, strict=True)]
    faint = [i for i, reason in enumerate(missing) if reason]
    current = form.editor + 1
    help_ = form.choice.help
    pressed = drop_down("##editor", form.choice.title, titles, current, ui, help_, lines, faint)
    if pressed is None:
        return form, action
    return (with_editor(form, pressed - 1), action) if pressed else (form, "paint_view")


def _settings(form: NewEdit, preview: PreviewState, column: float, ui: UiContext) -> NewEdit:
    """Draw the settings of the chosen editor and return the changed form."""
    match form.choice.setting:
        case "color":
            label("Color", column)
            flags = imgui.ColorEditFlags_
            hex_only = flags.display_hex.value | flags.no_label.value
            imgui.set_next_item_width(-1.0)
            changed, (red, green, blue) = imgui.color_edit3("##color", list(form.color), hex_only)
            form = replace(form, color=(red, green, blue)) if changed else form
            paths = {False: "Direct", True: "Hues"}
            help_ = "Path to the color: nearly straight, or around the color wheel"
            form = replace(form, through_hues=choice_row("Path", paths, form.through_hues, column, ui, help_))
        case "amount":
            help_ = "Share of the light to remove"
            label("Amount", column)
            form = replace(form, amount=value_slider("##Amount", form.amount, (0.05, 0.98), "%.2f", 0.7, ui))
            tip(help_)
        case "style":
            label("Style", column)
            form = _style(form, preview, ui)
        case "sentence":
            form = replace(form, sentence=_text_row("Text", "turn him into a statue", form.sentence, column))
            form = _model(form, preview, column, ui)
        case "server":
            form = replace(form, sentence=_text_row("Text", "turn him into a statue", form.sentence, column))
            form = _outside(form, ("server", "model", "price"), column)
        case "workflow":
            form = replace(form, sentence=_text_row("Text", "the workflow's own", form.sentence, column))
            form = _outside(form, ("workflow", "comfy", "price"), column)
        case "program":
            form = _outside(form, ("program",), column)
        case "pictures":
            form = replace(form, pictures=_text_row("Pictures", "A.png, B.png", form.pictures, column))
            taken = f"One or more pictures taken here ({shortcut('take_view')})"
            tip(f"{taken} and edited in any program")
        case "folder":
            form = replace(form, folder=_text_row("Folder", "FOLDER", form.folder, column))
            tip("Pictures of the training views, edited by any program")
    return form


def _model(form: NewEdit, preview: PreviewState, column: float, ui: UiContext) -> NewEdit:
    """Draw the list of diffusion models."""
    label("Model", column)
    imgui.set_next_item_width(-1.0)
    models = ["", *preview.models]
    titles = [model.partition("/")[2] or model or "Best fit for this machine" for model in models]
    index = models.index(form.model) if form.model in models else 0
    pressed = drop_down("##model", titles[index], titles, index, ui, "Models on this machine")
    return form if pressed is None else replace(form, model=models[pressed], asks=0)


_OUTSIDE_ROWS = {
    "server": ("Server", "http://127.0.0.1:8080/v1", "Address of a server with OpenAI's images API"),
    "model": ("Model", "name", "Name of the server's model"),
    "comfy": ("Server", "http://127.0.0.1:8188", "Address of ComfyUI"),
    "workflow": ("Workflow", "workflow.json", "Saved with Export (API); its titled nodes are filled"),
    "program": ("Program", "magick {input} -negate {output}", "Runs once per view; {A..B} is a strength"),
    "price": ("Price", "per picture, if known", "Price of one picture, to estimate the cost"),
}


def _outside(form: NewEdit, names: Sequence[str], column: float) -> NewEdit:
    """Draw settings of a program or a server, and the place and cost of the pictures."""
    settings = form.outside
    for name in names:
        title, hint, help_ = _OUTSIDE_ROWS[name]
        settings = replace(settings, **{name: _text_row(title, hint, getattr(settings, name), column)})
        tip(help_)
    form = replace(form, outside=settings)
    if form.outside_note:
        wrapped_text(form.outside_note, PALETTE.dim)
    return form


def _anchor(form: NewEdit, preview: PreviewState, column: float) -> tuple[NewEdit, str]:
    """Draw the buttons for the anchor, the reference of all views: generate, or edit ("paint_over")."""
    label("Anchor", column)
    half = 0.5 * (imgui.get_content_region_avail().x - imgui.get_style().item_spacing.x)
    with inert(bool(form.obstacle) or preview.busy):
        first = "Test view" if form.choice.is_outside else "Paint this view"
        pressed = imgui.button("Again" if form.asks else first, imgui.ImVec2(half, 0.0))
        if pressed and not form.choice.is_outside:
            form = replace(form, asks=form.asks + 1, anchor="")
    tip("Edit this view. All views will follow the picture; without one, they follow the front view")
    imgui.same_line()
    with inert(not preview.painted):
        action = "paint_over" if imgui.button("Paint over", imgui.ImVec2(half, 0.0)) else ""
    if pressed and form.choice.is_outside:
        action = "test_editor"
    tip(form.anchor or "Open it in your painting program; each save is shown, the last one is trained")
    if preview.text:
        wrapped_text(preview.text, PALETTE.error if preview.failed else PALETTE.dim)
    return form, action


def _style(form: NewEdit, preview: PreviewState, ui: UiContext) -> NewEdit:
    """Draw a button for every style, with a thumbnail of this view once it is painted. The most consistent
    styles, `BEST_STYLES`, come first."""
    small(f"Painting {form.style}", PALETTE.text)
    gap = HALF_GAP_PX * ui.scale
    canvas = imgui.get_window_draw_list()
    wide = (imgui.get_content_region_avail().x - (SHEET_COLUMNS - 1) * gap) / SHEET_COLUMNS
    side = imgui.ImVec2(wide, wide * SHEET_PX[1] / SHEET_PX[0])
    rows = -(-len(STYLE_ORDER) // SHEET_COLUMNS)
    imgui.push_style_var(imgui.StyleVar_.item_spacing, (gap, gap))
    for index, number in enumerate(STYLE_ORDER):
        row, column = divmod(index, SHEET_COLUMNS)
        if column:
            imgui.same_line(0.0, gap)
        if imgui.button(f"{number}##style", side):
            form = replace(form, style=number)
        low = imgui.get_item_rect_min()
        high = imgui.get_item_rect_max()
        if number in preview.styles:
            ends = ((column + i) / SHEET_COLUMNS for i in (0, 1)), ((row + i) / rows for i in (0, 1))
            (left, right), (top, foot) = ends
            image = imgui.ImTextureRef(preview.sheet)
            white = u32((1.0, 1.0, 1.0, 1.0))
            canvas.add_image_rounded(image, low, high, (left, top), (right, foot), white, 3.0 * ui.scale)
        if number == form.style:
            canvas.add_rect(low, high, u32(PALETTE.accent), 3.0 * ui.scale, 2.0 * ui.scale)
        best = "; consistent from all sides" if number in BEST_STYLES else ""
        tip(f"Painting {number}{best}")
    imgui.pop_style_var()
    imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() + gap)
    return form


def _preview(form: NewEdit, preview: PreviewState, column: float, ui: UiContext) -> NewEdit:
    """Draw the preview's visibility and strength, and its state."""
    if not form.choice.pictured:
        if form.choice.setting == "folder":
            small("No preview: the views are already edited", PALETTE.dim)
        if form.choice.setting == "pictures" and preview.text:
            wrapped_text(preview.text, PALETTE.error if preview.failed else PALETTE.dim)
        return form
    label("Preview", column)
    side = imgui.get_frame_height()
    if icon_button("preview", Icon.SHOWN if form.preview else Icon.HIDDEN, ui, dim=not form.preview):
        form = replace(form, preview=not form.preview)
    tip("Preview the edit in this view before training")
    imgui.same_line(column + side)
    with inert(not form.preview):
        strength = value_slider("##strength", form.strength, (0.0, 1.0), "%.2f", 1.0, ui)
    form = replace(form, strength=strength)
    tip("Strength of the preview. Training learns all strengths")
    if form.preview and preview.failed:
        wrapped_text(preview.text, PALETTE.error)
    else:
        # always one line, so that nothing below moves
        small(preview.text or " ", _NEAR_COLORS.get(preview.near, PALETTE.dim))
        if preview.near:
            tip("Expected difference of the trained edit from this preview, estimated in a few views")
    return form


def _text_row(title: str, hint: str, text: str, column: float) -> str:
    """Draw a text field to the end of its line, with its name at the left."""
    label(title, column)
    imgui.set_next_item_width(-1.0)
    return str(imgui.input_text_with_hint(f"##text of {title}", hint, text)[1])


def _effort(form: NewEdit) -> str:
    return "A draft: less than a minute for a small region" if form.quick else "A few minutes"
