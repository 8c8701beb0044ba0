"""The panel: draws a state, returns the changed state. imgui only: no scene, no GL, no files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from imgui_bundle import imgui

from progdf.compose import BLENDS

from . import strength_slider, turntable
from .layer_rows import LayerRow
from .state import LayerState, Vec3, ViewState
from .ui_context import PALETTE, SMALL_PX, Icon, Rgba, UiContext, u32

WIDTH_PX = 300.0  # at 1×

UPS: tuple[tuple[str, Vec3], ...] = (
    ("+Y", (0.0, 1.0, 0.0)),
    ("−Y", (0.0, -1.0, 0.0)),
    ("+Z", (0.0, 0.0, 1.0)),
    ("−Z", (0.0, 0.0, -1.0)),
)

BLEND_HELP = {
    "normalised": "Overlapping edits share a Gaussian by their weights; never more than a full edit.",
    "sum": "Overlapping edits add up.",
    "over": "A later edit covers the ones above it in the list, as far as its strength goes.",
}


@dataclass(frozen=True)
class PanelInput:
    """What the panel shows besides the state.

    Args:
        title: the scene's name
        count: Gaussians in the scene
        rows: one per .gdf, indexed by `LayerState.gdf`
        focus: the focused layer, an index into `state.layers`, or None
        undos, redos: how many entries there are either way
        reveal: scroll to the focused layer
    """

    title: str
    count: int
    rows: Sequence[LayerRow]
    focus: int | None = None
    undos: int = 0
    redos: int = 0
    reveal: bool = False


@dataclass(frozen=True)
class PanelResult:
    """The changed state, the focused layer, and the actions asked for (named as in `controls.KEYS`)."""

    state: ViewState
    focus: int | None
    actions: tuple[str, ...] = ()


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
    _title(shown, ui)
    footer = imgui.get_frame_height() + imgui.get_style().item_spacing.y * 2
    imgui.begin_child("body", imgui.ImVec2(0.0, -footer), 0, flags.no_nav.value)
    state = _edits_header(state, ui)
    state, focus = _layers(state, shown, ui)
    state = _view(state, ui, actions)
    imgui.end_child()
    _footer(shown, ui, actions)
    imgui.end()
    return PanelResult(state, focus, tuple(actions))


def _title(shown: PanelInput, ui: UiContext) -> None:
    imgui.push_font(ui.fonts.bold, 0.0)
    room = imgui.get_content_region_avail().x
    imgui.text(elided(shown.title, room))
    imgui.pop_font()
    _small(f"{grouped(shown.count)} splats", PALETTE.dim)
    imgui.dummy(imgui.ImVec2(0.0, 2.0 * ui.scale))


def _edits_header(state: ViewState, ui: UiContext) -> ViewState:
    right = _right_edge()
    _section("Edits", ui)
    if len(state.layers) < 2:
        return state
    combo = 118.0 * ui.scale
    imgui.same_line(right - combo)
    imgui.set_next_item_width(combo)
    if imgui.begin_combo("##blend", state.blend.capitalize()):
        for blend in BLENDS:
            if imgui.selectable(blend.capitalize(), blend == state.blend)[0]:
                state = replace(state, blend=blend)
            _tip(BLEND_HELP[blend])
        imgui.end_combo()
    else:
        _tip("Where edits overlap: " + BLEND_HELP[state.blend])
    return state


def _layers(state: ViewState, shown: PanelInput, ui: UiContext) -> tuple[ViewState, int | None]:
    focus = shown.focus
    if not state.layers:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_disabled("No edits are loaded. Drop a .gdf file on the window.")
        imgui.pop_text_wrap_pos()
    layers = list(state.layers)
    for i, layer in enumerate(layers):
        layers[i], touched = _layer(i, layer, shown.rows[layer.gdf], focus == i, ui)
        if shown.reveal and focus == i:
            imgui.set_scroll_here_y(0.5)
        focus = i if touched else focus
    return replace(state, layers=tuple(layers)), focus


def _layer(
    index: int, layer: LayerState, row: LayerRow, focused: bool, ui: UiContext
) -> tuple[LayerState, bool]:
    """One card: eye, swatch, name and value; the slider; count and instruction."""
    scale, p = ui.scale, PALETTE
    imgui.push_id(index)
    canvas = imgui.get_window_draw_list()
    clip = canvas.get_clip_rect_min(), canvas.get_clip_rect_max()
    imgui.push_style_color(imgui.Col_.child_bg, imgui.ImVec4(*(p.card_focused if focused else p.card)))
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(10 * scale, 8 * scale))
    child = imgui.ChildFlags_
    imgui.begin_child(
        "card",
        imgui.ImVec2(0.0, 0.0),
        child.auto_resize_y.value | child.always_use_window_padding.value,
        imgui.WindowFlags_.no_nav.value,
    )
    layer = _layer_head(layer, row, ui)
    strength = strength_slider.draw(
        "##strength",
        layer.strength,
        row.recorded,
        imgui.get_content_region_avail().x,
        scale,
        p.accent if focused else p.accent_dark,
        layer.enabled,
    )
    touched = imgui.is_item_active()
    layer = replace(layer, strength=strength)
    note = f"{grouped(row.count)} splats" + (f"  ·  {row.instruction}" if row.instruction else "")
    _small(note, p.dim)
    pressed = imgui.is_window_hovered() and imgui.is_mouse_clicked(imgui.MouseButton_.left.value)
    if focused:
        _focus_bar(clip, scale)
    imgui.end_child()
    imgui.pop_style_var()
    imgui.pop_style_color()
    imgui.pop_id()
    return layer, touched or pressed


def _focus_bar(clip: tuple[imgui.ImVec2, imgui.ImVec2], scale: float) -> None:
    """A stripe along the left edge of the card that is being drawn, in the panel's clip."""
    canvas, corner = imgui.get_window_draw_list(), imgui.get_window_pos()
    edge = imgui.ImVec2(corner.x + 3 * scale, corner.y + imgui.get_window_size().y)
    canvas.push_clip_rect(*clip, False)
    canvas.add_rect_filled(corner, edge, u32(PALETTE.accent), 3 * scale)
    canvas.pop_clip_rect()


def _layer_head(layer: LayerState, row: LayerRow, ui: UiContext) -> LayerState:
    scale, p = ui.scale, PALETTE
    right = _right_edge()
    if _icon_button("eye", Icon.SHOWN if layer.enabled else Icon.HIDDEN, ui, dim=not layer.enabled):
        layer = replace(layer, enabled=not layer.enabled)
    _tip("Show or hide this edit (H)")
    imgui.same_line()
    _swatch(row.swatch, layer.enabled, ui)
    imgui.same_line()
    number = f"{layer.strength:.3f}"
    number_width = imgui.calc_text_size(number).x
    imgui.align_text_to_frame_padding()
    room = right - number_width - 10 * scale - imgui.get_cursor_pos_x()
    imgui.push_style_color(imgui.Col_.text, imgui.ImVec4(*(p.text if layer.enabled else p.dim)))
    imgui.text(elided(layer.name, room))
    imgui.same_line(right - number_width)
    imgui.text(number)
    imgui.pop_style_color()
    if imgui.is_item_clicked():
        strength_slider.start_typing("##strength")
    _tip("Click, or Ctrl+click the slider, to type a value")
    return layer


def _swatch(colour: tuple[float, float, float], enabled: bool, ui: UiContext) -> None:
    side = 12.0 * ui.scale
    x, y = imgui.get_cursor_screen_pos()
    top = y + (imgui.get_frame_height() - side) / 2
    imgui.dummy(imgui.ImVec2(side, imgui.get_frame_height()))
    rgba: Rgba = (*colour, 1.0 if enabled else 0.35)
    canvas = imgui.get_window_draw_list()
    corners = imgui.ImVec2(x, top), imgui.ImVec2(x + side, top + side)
    canvas.add_rect_filled(*corners, u32(rgba), 3 * ui.scale)
    canvas.add_rect(*corners, u32(PALETTE.line), 3 * ui.scale)


def _view(state: ViewState, ui: UiContext, actions: list[str]) -> ViewState:
    imgui.dummy(imgui.ImVec2(0.0, 4.0 * ui.scale))
    _section("View", ui)
    label = 82.0 * ui.scale
    camera = state.camera
    _label("Move", label)
    mode = _choice("mode", ("Orbit", "Fly"), ("orbit", "fly").index(camera.mode), ui)
    _tip("V")
    if mode is not None:
        camera = replace(camera, mode=("orbit", "fly")[mode])
    _label("Up axis", label)
    ups = (*UPS, ("View", turntable.axes(camera).up))
    current = next((i for i, (_, up) in enumerate(UPS) if up == camera.up), len(UPS))
    chosen = _choice("up", tuple(name for name, _ in ups), current, ui)
    _tip("The axis of the scene that is up; View takes what is up in the picture now")
    if chosen is not None:
        camera = turntable.with_up(camera, ups[chosen][1])
    _label("Lens", label)
    imgui.set_next_item_width(-1.0)
    camera = replace(
        camera, fov_y=imgui.slider_float("##fov", camera.fov_y, 10.0, 110.0, "%.0f°", _ALWAYS_CLAMP)[1]
    )
    _tip("Vertical field of view")
    _label("Background", label)
    picker = imgui.ColorEditFlags_.no_inputs.value | imgui.ColorEditFlags_.no_alpha.value
    red, green, blue = imgui.color_edit3("##background", list(state.background), picker)[1]
    _label("Show", label)
    half = (imgui.get_content_region_avail().x - 6.0 * ui.scale) / 2
    if imgui.button(f"{Icon.FRAME}  Frame", imgui.ImVec2(half, 0.0)):
        actions.append("frame")
    _tip("Frame the focused layer, or the whole scene (F)")
    imgui.same_line(0.0, 6.0 * ui.scale)
    if imgui.button(f"{Icon.HOME}  Home", imgui.ImVec2(half, 0.0)):
        actions.append("home")
    _tip("Back to the first view (Shift+F)")
    return replace(state, camera=camera, background=(red, green, blue))


_ALWAYS_CLAMP = imgui.SliderFlags_.always_clamp.value


def _footer(shown: PanelInput, ui: UiContext, actions: list[str]) -> None:
    imgui.separator()
    right = _right_edge()
    for action, icon, help_, usable in (
        ("undo", Icon.UNDO, f"Undo (Ctrl+Z), {shown.undos} to go", shown.undos > 0),
        ("redo", Icon.REDO, f"Redo (Ctrl+Shift+Z), {shown.redos} to go", shown.redos > 0),
    ):
        imgui.begin_disabled(not usable)
        if _icon_button(action, icon, ui):
            actions.append(action)
        imgui.end_disabled()
        _tip(help_)
        imgui.same_line()
    side = imgui.get_frame_height()
    imgui.same_line(right - 2 * side - 6.0 * ui.scale)
    if _icon_button("picture", Icon.PICTURE, ui):
        actions.append("picture")
    _tip("Save the picture as PNG (F2)")
    imgui.same_line(0.0, 6.0 * ui.scale)
    if _icon_button("help", Icon.HELP, ui):
        actions.append("help")
    _tip("Keys and mouse (F1)")


def _section(name: str, ui: UiContext) -> None:
    imgui.push_font(ui.fonts.bold, SMALL_PX)
    imgui.push_style_color(imgui.Col_.text, imgui.ImVec4(*PALETTE.dim))
    imgui.align_text_to_frame_padding()
    imgui.text(name.upper())
    imgui.pop_style_color()
    imgui.pop_font()


def _right_edge() -> float:
    """Where the line ends, in the coordinates of `same_line`; ask at the line's start."""
    return float(imgui.get_cursor_pos_x() + imgui.get_content_region_avail().x)


def _label(text: str, column: float) -> None:
    imgui.align_text_to_frame_padding()
    imgui.text_disabled(text)
    imgui.same_line(column)


def _small(text: str, colour: Rgba) -> None:
    imgui.push_font(None, SMALL_PX)
    imgui.text_colored(imgui.ImVec4(*colour), elided(text, imgui.get_content_region_avail().x))
    imgui.pop_font()


def _tip(text: str) -> None:
    flags = imgui.HoveredFlags_
    if imgui.is_item_hovered(flags.for_tooltip.value | flags.allow_when_disabled.value):
        imgui.set_tooltip(text)


def _icon_button(name: str, icon: str, ui: UiContext, dim: bool = False) -> bool:
    side = imgui.get_frame_height()
    imgui.push_style_color(imgui.Col_.button, imgui.ImVec4(0.0, 0.0, 0.0, 0.0))
    imgui.push_style_color(imgui.Col_.text, imgui.ImVec4(*(PALETTE.faint if dim else PALETTE.text)))
    imgui.push_style_var(imgui.StyleVar_.frame_padding, imgui.ImVec2(0.0, 5.0 * ui.scale))
    pressed = imgui.button(f"{icon}##{name}", imgui.ImVec2(side, 0.0))
    imgui.pop_style_var()
    imgui.pop_style_color(2)
    return bool(pressed)


def _choice(name: str, options: Sequence[str], current: int | None, ui: UiContext) -> int | None:
    """A row of joined buttons; the index that was pressed, or None."""
    gap = 2.0 * ui.scale
    each = (imgui.get_content_region_avail().x - gap * (len(options) - 1)) / len(options)
    pressed = None
    imgui.begin_group()
    imgui.push_style_var(imgui.StyleVar_.frame_padding, imgui.ImVec2(0.0, 5.0 * ui.scale))
    for i, option in enumerate(options):
        if i:
            imgui.same_line(0.0, gap)
        colour = PALETTE.accent_dark if i == current else PALETTE.field
        imgui.push_style_color(imgui.Col_.button, imgui.ImVec4(*colour))
        if imgui.button(f"{option}##{name}", imgui.ImVec2(each, 0.0)):
            pressed = i
        imgui.pop_style_color()
    imgui.pop_style_var()
    imgui.end_group()
    return pressed


def grouped(count: int) -> str:
    """12345 as "12 345", with a thin space."""
    return f"{count:,}".replace(",", "\u2009")


def elided(text: str, room: float) -> str:
    """The text, shortened with "…" to fit `room` window pixels in the present font."""
    if imgui.calc_text_size(text).x <= room:
        return text
    kept = text
    while kept and imgui.calc_text_size(kept + "…").x > room:
        kept = kept[:-1]
    return kept.rstrip() + "…"
