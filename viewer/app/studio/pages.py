"""What is drawn over the window: the start page, which way is up, a preview, the fields of a delivery."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from imgui_bundle import imgui

from progdf import __version__
from progdf.io.session import SUFFIX
from progdf.terminal import escape_text
from viewer.camera.view_camera import SHAPES, ViewCamera
from viewer.jobs.job_queue import FORMAT_NAMES, FORMATS, FPS, SIDES, DeliverOptions, film_title, picture_size
from viewer.state.view_state import ViewState
from viewer.ui import overlay
from viewer.ui.context import BEHIND, FIXED, PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.overlay import Area
from viewer.ui.widgets import (
    accent_button,
    choice,
    drop_down,
    elide,
    hint,
    label,
    picture,
    plate,
    right_edge,
    small,
    tip,
)

COMMANDS = ("open", "demo", "quit", "full_screen", "window_picture", "help", "palette", "unfocus", "about")
"""Those that mean something here."""
CARD_PX, GAP_PX, MARGIN_PX, DROP_PX = 168.0, 16.0, 28.0, 84.0
ROW_GAP_PX = 8.0
WIDEST_PX = 4 * CARD_PX + 3 * GAP_PX


@dataclass(frozen=True)
class RecentFile:
    """A scene or session that was open. `texture`: the GL name of its picture, 0 for none"""

    path: Path
    texture: int = 0


def draw_start_page(recent: Sequence[RecentFile], ui: UiContext) -> list[str]:
    """The page, over the whole window; the actions that were asked for."""
    display, scale = imgui.get_io().display_size, ui.scale
    imgui.set_next_window_pos(imgui.ImVec2(0.0, 0.0))
    imgui.set_next_window_size(display)
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(0.0, 0.0))
    imgui.begin("start page", None, FIXED | BEHIND)
    imgui.pop_style_var()
    wide = min(WIDEST_PX * scale, display.x - 2 * MARGIN_PX * scale)
    cards = max(int((wide + GAP_PX * scale) // ((CARD_PX + GAP_PX) * scale)), 1)
    rows = -(-len(recent) // cards)
    tall = (126.0 + DROP_PX + GAP_PX + rows * (0.75 * CARD_PX + 46.0 + ROW_GAP_PX)) * scale
    left = (display.x - wide) / 2
    imgui.set_cursor_pos(imgui.ImVec2(left, max((display.y - tall) / 2.6, MARGIN_PX * scale)))
    imgui.begin_child("middle", imgui.ImVec2(wide, 0.0))
    actions = _head(ui)
    if recent:
        small("Recent", PALETTE.dim)
        actions += _grid(recent, cards, ui)
    _drop_target(wide, ui)
    imgui.end_child()
    imgui.end()
    return actions


def _head(ui: UiContext) -> list[str]:
    scale, actions = ui.scale, []
    imgui.push_font(ui.fonts.bold, 26.0)
    imgui.text("ProGDF Studio")
    imgui.pop_font()
    imgui.same_line()
    imgui.push_font(None, SMALL_PX)
    imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() + 11.0 * scale)
    imgui.text_disabled(__version__)
    imgui.pop_font()
    imgui.dummy(imgui.ImVec2(0.0, 2.0 * scale))
    size = imgui.ImVec2(150.0 * scale, 34.0 * scale)
    if accent_button(f"{Icon.OPEN}  Open…", size):
        actions.append("open")
    hint("open")
    imgui.same_line(0.0, 10.0 * scale)
    if imgui.button("Try the demo", size):
        actions.append("demo")
    hint("demo")
    imgui.dummy(imgui.ImVec2(0.0, 10.0 * scale))
    return actions


def _grid(recent: Sequence[RecentFile], cards: int, ui: UiContext) -> list[str]:
    actions = []
    for i, file in enumerate(recent):
        if i % cards:
            imgui.same_line(0.0, GAP_PX * ui.scale)
        elif i:
            imgui.dummy(imgui.ImVec2(0.0, ROW_GAP_PX * ui.scale))
        imgui.push_id(i)
        if _card(file, ui):
            actions.append(f"open_file:{file.path}")
        imgui.pop_id()
    return actions


def _card(file: RecentFile, ui: UiContext) -> bool:
    """A picture, the name and the folder; whether it was clicked."""
    wide, tall, rounding = CARD_PX * ui.scale, 0.75 * CARD_PX * ui.scale, 5.0 * ui.scale
    imgui.begin_group()
    at = imgui.get_cursor_screen_pos()
    pressed = bool(imgui.invisible_button("file", imgui.ImVec2(wide, tall)))
    hovered = imgui.is_item_hovered()
    tip(escape_text(str(file.path)))
    canvas, end = imgui.get_window_draw_list(), imgui.ImVec2(at.x + wide, at.y + tall)
    picture(file.texture, at, end, rounding)
    if not file.texture:
        size = imgui.calc_text_size(Icon.PICTURE)
        middle = imgui.ImVec2(round(at.x + (wide - size.x) / 2), round(at.y + (tall - size.y) / 2))
        canvas.add_text(middle, u32(PALETTE.field_hovered), Icon.PICTURE)
    if hovered:
        canvas.add_rect(at, end, u32(PALETTE.accent), rounding, 2.0 * ui.scale)
    imgui.text(elide(escape_text(file.path.name.removesuffix(SUFFIX)), wide))
    imgui.push_font(None, SMALL_PX)
    imgui.text_disabled(elide(escape_text(_folder(file.path)), wide))
    imgui.pop_font()
    imgui.end_group()
    return pressed


def _folder(path: Path) -> str:
    """Where it lies, with ~ for the user's home."""
    try:
        return f"~/{path.parent.relative_to(Path.home())}"
    except (ValueError, RuntimeError):
        return str(path.parent)


def _drop_target(wide: float, ui: UiContext) -> None:
    """A dashed frame; files may be dropped anywhere, and this says so."""
    scale = ui.scale
    imgui.dummy(imgui.ImVec2(0.0, 6.0 * scale))
    x, y = imgui.get_cursor_screen_pos()
    tall, dash = DROP_PX * scale, 7.0 * scale
    imgui.dummy(imgui.ImVec2(wide, tall))
    x, y, wide, tall = x + scale, y + scale, wide - 2 * scale, tall - 2 * scale
    canvas, ink = imgui.get_window_draw_list(), u32(PALETTE.field_hovered)
    sides = ((x, y, wide, 1, 0), (x, y + tall, wide, 1, 0), (x, y, tall, 0, 1), (x + wide, y, tall, 0, 1))
    for left, top, length, dx, dy in sides:
        for i in range(int(length / (2 * dash)) + 1):
            low, high = 2 * i * dash, min((2 * i + 1) * dash, length)
            begin = imgui.ImVec2(left + dx * low, top + dy * low)
            end = imgui.ImVec2(left + dx * high, top + dy * high)
            canvas.add_line(begin, end, ink, 1.5 * scale)
    text = "Drop a scene or a session anywhere in this window"
    size = imgui.calc_text_size(text)
    at = imgui.ImVec2(round(x + (wide - size.x) / 2), round(y + (tall - size.y) / 2))
    canvas.add_text(at, u32(PALETTE.dim), text)


UP_SIZE = (160, 120)
"""Pixels of a picture."""
_PICTURE_PX = 128.0
"""Of a picture at 1×, where there is room."""
_GAP_PX, _PAD_PX, _TITLE_PX = 8.0, 10.0, 24.0


@dataclass(frozen=True)
class UpChoice:
    """A direction that may be up."""

    name: str  # as "+Y"
    camera: ViewCamera  # the first view if it is
    texture: int = 0  # GL name of its picture, 0 while there is none


@dataclass(frozen=True)
class UpStrip:
    """The question while it is asked; `now` is what counts as up meanwhile."""

    choices: tuple[UpChoice, ...]
    now: str


def up_strip_height(strip: UpStrip | None, area: Area, ui: UiContext) -> float:
    """How much of the lower edge of the picture it covers, window pixels."""
    if strip is None:
        return 0.0
    return 0.75 * _picture_width(strip, area, ui) + (2 * _PAD_PX + _TITLE_PX + _GAP_PX) * ui.scale


def draw_up_strip(strip: UpStrip, area: Area, ui: UiContext) -> tuple[str, ...]:
    """Draw it along the lower edge of `area`; the requests that come of it."""
    wide, scale, requests = _picture_width(strip, area, ui), ui.scale, list[str]()
    tall = up_strip_height(strip, area, ui) - _GAP_PX * scale
    count = len(strip.choices)
    across = count * wide + ((count - 1) * _GAP_PX + 2 * _PAD_PX) * scale
    place = imgui.ImVec2(area.width / 2, area.height - _GAP_PX * scale)
    with plate("up axis", place, ui, (0.5, 1.0), _PAD_PX, imgui.ImVec2(across, tall)):
        top, right = imgui.get_cursor_pos_y(), right_edge()
        imgui.text("Which way is up?")
        keep = f"Keep {strip.now} (Esc)"
        imgui.push_font(None, SMALL_PX)
        room = imgui.calc_text_size(keep).x + 2 * imgui.get_style().frame_padding.x
        if right - room > imgui.get_item_rect_size().x + _PAD_PX * scale:
            imgui.same_line(right - room)
            if imgui.small_button(keep):
                requests.append("keep_up")
        imgui.pop_font()
        for i, direction in enumerate(strip.choices):
            imgui.set_cursor_pos(
                imgui.ImVec2((_PAD_PX + i * _GAP_PX) * scale + i * wide, top + _TITLE_PX * scale)
            )
            if _up_picture(direction, wide, direction.name == strip.now, ui):
                requests.append(f"set_up:{i}")
    return tuple(requests)


def _picture_width(strip: UpStrip, area: Area, ui: UiContext) -> float:
    """Of a picture, window pixels."""
    count = len(strip.choices)
    room = area.width - (2 * _PAD_PX + (count + 1) * _GAP_PX) * ui.scale
    return max(min(_PICTURE_PX * ui.scale, room / count), 24.0 * ui.scale)


def _up_picture(direction: UpChoice, wide: float, now: bool, ui: UiContext) -> bool:
    at, rounding = imgui.get_cursor_screen_pos(), 4.0 * ui.scale
    pressed = bool(imgui.invisible_button(direction.name, imgui.ImVec2(wide, 0.75 * wide)))
    canvas, end = imgui.get_window_draw_list(), imgui.ImVec2(at.x + wide, at.y + 0.75 * wide)
    picture(direction.texture, at, end, rounding)
    if now or imgui.is_item_hovered():
        ink = PALETTE.accent if imgui.is_item_hovered() else PALETTE.dim
        canvas.add_rect(at, end, u32(ink), rounding, 2.0 * ui.scale)
    size, pad = SMALL_PX * ui.scale, 4.0 * ui.scale
    imgui.push_font(ui.fonts.bold, SMALL_PX)
    text = imgui.calc_text_size(direction.name)
    imgui.pop_font()
    corner = imgui.ImVec2(at.x + text.x + 2 * pad, at.y + size + pad)
    canvas.add_rect_filled(at, corner, u32(PALETTE.scrim), rounding)
    at = imgui.ImVec2(round(at.x + pad), round(at.y + pad / 2))
    canvas.add_text(ui.fonts.bold, size, at, u32(PALETTE.text), direction.name)
    return pressed


@dataclass(frozen=True)
class Cover:
    """A picture that lies over the view, as long as one looks from where it was made."""

    texture: int  # its GL name
    camera: ViewCamera  # where one looks from
    size: tuple[int, int]  # of the view, pixels
    name: str = ""  # the banner above it


def draw_cover(cover: Cover, view: ViewState, size: tuple[int, int], area: Area, ui: UiContext) -> None:
    """Draw it over the view, where it belongs there."""
    if (cover.camera, cover.size) != (view.camera, size) or view.compare.mode != "off":
        return
    corners = imgui.ImVec2(0.0, 0.0), imgui.ImVec2(area.width, area.height)
    imgui.get_background_draw_list().add_image(imgui.ImTextureRef(cover.texture), *corners)
    overlay.banner(cover.name, area, ui)


_COLUMN_PX = 100.0
_LARGEST = 16_384


def draw_fields(kind: str, path: str, options: DeliverOptions, ui: UiContext) -> tuple[str, DeliverOptions]:
    """The path with the suffix that fits, and the options as they are now.

    Args:
        kind: "picture" or "film"
    """
    column = _COLUMN_PX * ui.scale
    options = _size_fields(options, column, ui)
    if kind == "picture":
        label("Background", column)
        pressed = choice("alpha", ("As shown", "Transparent"), int(options.alpha), ui)
        return path, options if pressed is None else replace(options, alpha=pressed == 1)
    label("Moves", column)
    imgui.set_next_item_width(-1.0)
    titles = [film_title(name) for name in options.can_move]
    now = options.can_move.index(options.moves)
    pressed = drop_down("##moves", titles[now], titles, now, ui, "What moves in the film")
    options = options if pressed is None else replace(options, moves=options.can_move[pressed])
    label("Format", column)
    pressed = choice("format", FORMAT_NAMES, FORMATS.index(options.format), ui)
    if pressed is not None:
        options = replace(options, format=FORMATS[pressed])
        path = str(Path(path).with_suffix(options.format)) if path.strip() else path
    label("Frames/s", column)
    at = FPS.index(options.fps) if options.fps in FPS else None
    pressed = choice("fps", [str(fps) for fps in FPS], at, ui)
    options = options if pressed is None else replace(options, fps=FPS[pressed])
    if options.moves != "timeline":
        label("Seconds", column)
        imgui.set_next_item_width(-1.0)
        clamp = imgui.SliderFlags_.always_clamp.value
        changed, seconds = imgui.slider_float("##seconds", options.seconds, 1.0, 20.0, "%.0f s", clamp)
        options = replace(options, seconds=round(seconds)) if changed else options
        tip("There and back again")
    return path, options


def _size_fields(options: DeliverOptions, column: float, ui: UiContext) -> DeliverOptions:
    """Width and height, typed, or one of the usual ones."""
    label("Size", column)
    gap, room = 6.0 * ui.scale, imgui.get_content_region_avail().x
    imgui.set_next_item_width(0.22 * room)
    _, width = imgui.input_int("##width", options.width, 0)
    imgui.same_line(0.0, gap)
    imgui.text_disabled("×")
    imgui.same_line(0.0, gap)
    imgui.set_next_item_width(0.22 * room)
    _, height = imgui.input_int("##height", options.height, 0)
    imgui.same_line(0.0, 2 * gap)
    size = min(max(width, 1), _LARGEST), min(max(height, 1), _LARGEST)
    shapes, side = tuple(SHAPES), min(size)
    shape = next((name for name in shapes if picture_size(side, name) == size), None)
    at = SIDES.index(side) if shape and side in SIDES else None
    pressed = choice("size", [f"{side}p" for side in SIDES], at, ui)
    if pressed is not None:
        size = picture_size(SIDES[pressed], shape or shapes[0])
    label("Shape", column)
    pressed = choice("shape", shapes, shapes.index(shape) if shape else None, ui)
    if pressed is not None:
        size = picture_size(side, shapes[pressed])
    return replace(options, width=size[0], height=size[1])
