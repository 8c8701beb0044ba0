"""The form of a new edit: region, editor and its few settings, its picture's strength, and Train."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from imgui_bundle import imgui

from viewer.jobs.new_edit import (
    ALL,
    BEST_STYLES,
    CHANGED,
    EDITORS,
    SELECTION,
    STYLES,
    TYPED,
    NewEdit,
    missing_package,
    with_editor,
)
from viewer.ui.context import PALETTE, Icon, UiContext
from viewer.ui.widgets import (
    accent_button,
    card,
    choice,
    elide,
    group_digits,
    icon_button,
    label,
    right_edge,
    small,
    tip,
    value_slider,
    wrapped,
)

COLUMN_PX = 66.0


@dataclass(frozen=True)
class FormInput:
    """What the form shows besides its own state.

    Args:
        count: Gaussians in the scene
        selected: how many of them are selected
        regions: names and sizes of the regions that were kept
        picture: what the editor's picture is at: "", a word such as "drawing", or why there is none
        failed: `picture` says why there is none
    """

    count: int = 0
    selected: int = 0
    regions: Sequence[tuple[str, int]] = ()
    picture: str = ""
    failed: bool = False


def draw(form: NewEdit, shown: FormInput, ui: UiContext) -> tuple[NewEdit, str]:
    """The form as the hand leaves it, and what was asked for: "train", "new_edit" to close it, or ""."""
    with card("new edit", PALETTE.card_focused, ui):
        return _content(form, shown, ui)


def _content(form: NewEdit, shown: FormInput, ui: UiContext) -> tuple[NewEdit, str]:
    action, right = "", right_edge()
    imgui.push_font(ui.fonts.bold, 0.0)
    imgui.align_text_to_frame_padding()
    imgui.text("New edit")
    imgui.pop_font()
    imgui.same_line(right - imgui.get_frame_height())
    if icon_button("close form", Icon.CLOSE, ui, dim=True):
        action = "new_edit"
    tip("Close (Ctrl+N). What is being trained goes on")
    column = COLUMN_PX * ui.scale
    form = _region(form, shown, column)
    form = _editor(form, column)
    form = _settings(form, column, ui)
    label("Name", column)
    imgui.set_next_item_width(-1.0)
    form = replace(form, name=_text("##name", form.suggested_name, form.name))
    tip("Name of the layer and of its file")
    label("Quality", column)
    pressed = choice("quality", ("Draft", "Full"), 0 if form.quick else 1, ui)
    tip("A draft takes a third of the time")
    form = form if pressed is None else replace(form, quick=pressed == 0)
    form = _preview(form, shown, column, ui)
    error = form.error or missing_package(form.choice)
    if error:
        wrapped(error, PALETTE.error)
    imgui.begin_disabled(bool(form.obstacle))
    if accent_button(f"{Icon.TRAIN}  Train", imgui.ImVec2(-1.0, 0.0)):
        action = "train"
    imgui.end_disabled()
    tip(form.obstacle or f"Train it; it comes as a layer with a slider. {_effort(form)}")
    return form, action


def region_title(region: str, shown: FormInput) -> str:
    """A region in the list, with how much it holds."""
    sizes = dict(shown.regions)
    match region:
        case "all":
            return f"Whole scene  ·  {group_digits(shown.count)}"
        case "selection":
            return f"Selection  ·  {group_digits(shown.selected)}"
        case "changed":
            return "Where they differ"
        case "typed":
            return "Typed…"
    return f"{region}  ·  {group_digits(sizes.get(region, 0))}"


def _region(form: NewEdit, shown: FormInput, column: float) -> NewEdit:
    label("Region", column)
    imgui.set_next_item_width(-1.0)
    room = imgui.get_content_region_avail().x - 2 * imgui.get_frame_height()
    if imgui.begin_combo("##region", elide(region_title(form.region, shown), room)):
        offered = [SELECTION] * bool(shown.selected) + [name for name, _ in shown.regions] + [ALL, TYPED]
        offered = [CHANGED] * (form.choice.kind == "pictures") + offered
        for region in offered:
            if imgui.selectable(f"{region_title(region, shown)}##{region}", region == form.region)[0]:
                form = replace(form, region=region, error="")
        imgui.end_combo()
    else:
        tip("What may change")
    if form.region == TYPED:
        imgui.dummy(imgui.ImVec2(0.0, 0.0))
        imgui.same_line(column)
        imgui.set_next_item_width(-1.0)
        form = replace(form, typed_region=_text("##spec", "sphere:0,0,0,1", form.typed_region))
        tip("As progdf train --region: labels:FILE.npy:ID, box:…, sphere:…, file:ROWS.npy; join by + -")
    return form


def _editor(form: NewEdit, column: float) -> NewEdit:
    label("Editor", column)
    imgui.set_next_item_width(-1.0)
    if imgui.begin_combo("##editor", form.choice.title):
        for i, editor in enumerate(EDITORS):
            missing = missing_package(editor)
            imgui.push_style_color(
                imgui.Col_.text, imgui.ImVec4(*(PALETTE.faint if missing else PALETTE.text))
            )
            if imgui.selectable(editor.title, i == form.editor)[0]:
                form = with_editor(form, i)
            imgui.pop_style_color()
            tip(missing or editor.help)
        imgui.end_combo()
    else:
        tip(form.choice.help)
    return form


def _settings(form: NewEdit, column: float, ui: UiContext) -> NewEdit:
    """What this editor is asked."""
    match form.choice.setting:
        case "color":
            label("Color", column)
            flags = imgui.ColorEditFlags_
            shown = flags.display_hex.value | flags.no_label.value
            imgui.set_next_item_width(-1.0)
            changed, (red, green, blue) = imgui.color_edit3("##color", list(form.color), shown)
            form = replace(form, color=(red, green, blue)) if changed else form
            label("Path", column)
            pressed = choice("path", ("Straight", "Hues"), int(form.through_hues), ui)
            tip("Between original and color: the direct way, or around the color wheel")
            form = form if pressed is None else replace(form, through_hues=pressed == 1)
        case "amount":
            label("Amount", column)
            form = replace(form, amount=value_slider("##amount", form.amount, (0.05, 0.98), "%.2f", 0.7, ui))
            tip("Share of the light that is taken away")
        case "style":
            label("Style", column)
            form = _style(form, ui)
        case "sentence":
            label("Text", column)
            imgui.set_next_item_width(-1.0)
            form = replace(form, sentence=_text("##sentence", "turn him into a statue", form.sentence))
            tip("Needs a model on this machine; see progdf train --help")
        case "pictures":
            label("Pictures", column)
            imgui.set_next_item_width(-1.0)
            form = replace(form, pictures=_text("##pictures", "A.png, B.png", form.pictures))
            tip("One or a few pictures that were taken here (Ctrl+F2) and changed in any program")
        case "folder":
            label("Folder", column)
            imgui.set_next_item_width(-1.0)
            form = replace(form, folder=_text("##folder", "FOLDER", form.folder))
            tip("Pictures of the training views, edited by any program; see progdf views")
    return form


def _style(form: NewEdit, ui: UiContext) -> NewEdit:
    """Back, number, on; those that agree best from all sides come first."""
    order = (*BEST_STYLES, *(i for i in range(STYLES) if i not in BEST_STYLES))
    at, side, gap = order.index(form.style), imgui.get_frame_height(), 4.0 * ui.scale
    if imgui.button("‹##style", imgui.ImVec2(side, 0.0)):
        at -= 1
    imgui.same_line(0.0, gap)
    imgui.set_next_item_width(imgui.get_content_region_avail().x - side - gap)
    if imgui.begin_combo("##number", f"Painting {form.style}", imgui.ComboFlags_.no_arrow_button.value):
        for i, number in enumerate(order):
            if imgui.selectable(f"Painting {number}", i == at)[0]:
                at = i
        imgui.end_combo()
    else:
        tip("Which painting; the first six look most alike from all sides")
    imgui.same_line(0.0, gap)
    if imgui.button("›##style", imgui.ImVec2(side, 0.0)):
        at += 1
    return replace(form, style=order[at % len(order)])


def _preview(form: NewEdit, shown: FormInput, column: float, ui: UiContext) -> NewEdit:
    """The strength of the editor's own picture, and whether it is shown."""
    if not form.choice.pictured:
        if form.choice.kind != "pictures":
            small("No picture in advance: this editor takes its time", PALETTE.dim)
        return form
    label("Preview", column)
    side = imgui.get_frame_height()
    if icon_button("preview", Icon.SHOWN if form.preview else Icon.HIDDEN, ui, dim=not form.preview):
        form = replace(form, preview=not form.preview)
    tip("What the editor makes of the original in this view, before anything is trained")
    imgui.same_line(column + side)
    imgui.begin_disabled(not form.preview)
    form = replace(form, strength=value_slider("##strength", form.strength, (0.0, 1.0), "%.2f", 1.0, ui))
    imgui.end_disabled()
    tip("Strength of the preview. Training learns all strengths")
    if form.preview and shown.failed:
        wrapped(shown.picture, PALETTE.error)
    else:
        small(shown.picture or " ", PALETTE.dim)  # always a line, so that nothing below moves
    return form


def _text(name: str, hint: str, text: str) -> str:
    return str(imgui.input_text_with_hint(name, hint, text)[1])


def _effort(form: NewEdit) -> str:
    return "A draft: less than a minute for a small region" if form.quick else "A few minutes"
