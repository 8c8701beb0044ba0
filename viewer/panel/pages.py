"""Start page, the image that covers the picture, and the fields of a picture or film to render."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from imgui_bundle import imgui, imgui_ctx

from progdf import __version__
from progdf.io.session import SUFFIX
from progdf.terminal import escape_text
from viewer.camera.view_camera import LARGEST_SIDE, SHAPES
from viewer.state.commands import Action, Plain, WithText
from viewer.state.forms import FORMATS, FPS, SIDES, DeliverOptions, film_title, picture_size
from viewer.state.transient import StartFile
from viewer.state.workspace import Workspace
from viewer.ui import overlay
from viewer.ui.context import BEHIND, FIXED, PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.widgets import (
    accent_button,
    choice,
    choice_row,
    drop_down,
    elide,
    hint,
    icon_button,
    label,
    picture,
    small,
    tip,
)

COMMANDS = ("open", "demo", "quit", "full_screen", "window_picture", "help", "palette", "unfocus", "about")
"""Commands that are available on the start page."""
CARD_PX = 168.0  # approximate width of a recent file's card, at 1×
GAP_PX = 16.0
MARGIN_PX = 28.0
SIDE_PX = 264.0
WIDEST_PX = 1140.0
"""Maximum width of the page, at 1×."""
NARROW_PX = 760.0
"""Page width at 1× below which the left column stands above the right one."""
_TEXT_PX = 44.0  # height of the two lines below a picture
_HEADING_PX = 32.0  # height of a heading
_TITLE_PX = 44.0  # height of the title
_NO_NAV = imgui.ItemFlags_.no_nav.value
DROP_TEXT = "Drop a scene or a session"


def draw_start_page(
    recent: Sequence[StartFile], examples: Sequence[StartFile], ui: UiContext
) -> list[Action]:
    """Draw the start page over the whole window and return the requested actions."""
    display = imgui.get_io().display_size
    scale = ui.scale
    imgui.set_next_window_pos((0.0, 0.0))
    imgui.set_next_window_size(display)
    imgui.begin("start page", None, FIXED | BEHIND)
    wide = min(display.x - 2 * MARGIN_PX * scale, WIDEST_PX * scale)
    narrow = wide < NARROW_PX * scale
    left = (display.x - wide) / 2
    side = wide if narrow else SIDE_PX * scale
    right = left if narrow else left + side + 3 * GAP_PX * scale
    room = wide - (right - left)
    thirds = _columns(room, 3, ui)
    small_card = _columns(room, max(int(room // (CARD_PX * scale)), 1), ui)
    rows = -(-len(recent) // max(int(room // (CARD_PX * scale)), 1))
    examples_height = 0.75 * thirds + (_TEXT_PX + _HEADING_PX) * scale if examples else 0.0
    tall = examples_height + rows * (0.75 * small_card + (_TEXT_PX + GAP_PX) * scale)
    top = max((display.y - tall - 2 * _HEADING_PX * scale) / 2.6, MARGIN_PX * scale)
    imgui.set_cursor_pos((left, top))
    with imgui_ctx.begin_group():
        actions = _head(side, 0.0 if narrow else max(0.75 * thirds, 120.0 * scale), ui)
    level = imgui.get_cursor_pos_y() + 0.5 * GAP_PX * scale if narrow else top + _TITLE_PX * scale
    imgui.set_cursor_pos((right, level - (0.0 if narrow else 19.0 * scale)))
    with imgui_ctx.begin_group():
        for heading, files, across in (("Examples", examples, thirds), ("Recent", recent, small_card)):
            if files:
                small(heading, PALETTE.dim)
                actions += _grid(files, across, room, heading == "Recent", ui)
                imgui.dummy((0.0, 0.5 * GAP_PX * scale))
    imgui.dummy((0.0, 0.5 * MARGIN_PX * scale))
    imgui.end()
    return actions


def _columns(room: float, count: int, ui: UiContext) -> float:
    """Return the width of each of `count` cards in a row, in pixels."""
    return float(int((room - (count - 1) * GAP_PX * ui.scale) / count))


def _head(wide: float, tall: float, ui: UiContext) -> list[Action]:
    """Draw the program's name and the buttons that open a file or train the demo.

    `tall` is the height of the drop field in pixels; 0 draws it as one line.
    """
    scale = ui.scale
    actions = list[Action]()
    flat = not tall
    begin = imgui.get_cursor_pos()
    with imgui_ctx.push_font(ui.fonts.bold, 26.0):
        imgui.text("ProGDF Studio")
    imgui.same_line()
    with imgui_ctx.push_font(None, SMALL_PX):
        imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() + 11.0 * scale)
        imgui.text_disabled(__version__)
    x = begin.x
    y = begin.y + _TITLE_PX * scale
    button = imgui.ImVec2(136.0 * scale, 34.0 * scale)
    frame = imgui.ImVec2(wide, tall or 58.0 * scale)
    # margin around the button of a field of one line
    text = imgui.calc_text_size(DROP_TEXT)
    side = (frame.y - button.y) / 2
    middle = x + (frame.x - button.x) / 2, y + frame.y / 2
    imgui.set_cursor_pos(
        (x + button.x + 2 * side, y + (frame.y - text.y) / 2)
        if flat
        else (x + (frame.x - text.x) / 2, middle[1] - 32.0 * scale)
    )
    imgui.text_disabled(DROP_TEXT)
    imgui.set_cursor_pos((x + side, y + side) if flat else (middle[0], middle[1] - 2.0 * scale))
    if accent_button(f"{Icon.OPEN}  Open…", button):
        actions.append(Plain("open"))
    hint("open")
    if flat:
        imgui.set_cursor_pos((x + frame.x - button.x - side, y + side))
    else:
        imgui.set_cursor_pos((x, y + frame.y + 12.0 * scale))
    imgui.push_item_flag(_NO_NAV, True)
    if imgui.button("Train the demo", (button.x if flat else wide, button.y)):
        actions.append(Plain("demo"))
    imgui.pop_item_flag()
    hint("demo")
    imgui.set_cursor_pos((x, y))
    _dashed_frame(frame, ui)
    return actions


def _grid(files: Sequence[StartFile], wide: float, room: float, own: bool, ui: UiContext) -> list[Action]:
    """Draw cards of `wide` pixels and return the requested actions. `own`: the user can remove the cards."""
    actions = list[Action]()
    gap = GAP_PX * ui.scale
    across = max(int((room + gap + 1.0) // (wide + gap)), 1)
    for i, file in enumerate(files):
        if i % across:
            imgui.same_line(0.0, gap)
        with imgui_ctx.push_id(str(file.path)):
            actions += _card(file, wide, own, ui)
    return actions


def _card(file: StartFile, wide: float, own: bool, ui: UiContext) -> list[Action]:
    """Draw a picture with two lines of text and return the action requested by click, Enter or the close
    button."""
    tall = 0.75 * wide
    rounding = 5.0 * ui.scale
    scale = ui.scale
    imgui.begin_group()
    at = imgui.get_cursor_screen_pos()
    requested = list[Action]()
    storage = imgui.get_state_storage()
    known = int(imgui.internal.get_current_window().id_)
    if not storage.get_bool(known):  # the first card has the keyboard focus
        storage.set_bool(known, True)
        imgui.set_keyboard_focus_here()
        imgui.set_nav_cursor_visible(True)
    imgui.set_next_item_allow_overlap()
    if imgui.invisible_button("file", (wide, tall), imgui.ButtonFlags_.enable_nav.value):
        opened = WithText("open_file" if own else "example", str(file.path))
        requested = [Plain("open") if file.missing else opened]
    hovered = imgui.is_item_hovered(
        imgui.HoveredFlags_.no_nav_override.value
    )  # imgui frames the item with the keyboard focus
    if own and imgui.is_item_focused() and imgui.is_key_pressed(imgui.Key.delete, False):
        requested = [WithText("forget_file", str(file.path))]
    path = escape_text(str(file.path))
    tip(f"{path} was not found. Open it from its new location." if file.missing else path)
    canvas = imgui.get_window_draw_list()
    end = imgui.ImVec2(at.x + wide, at.y + tall)
    picture(file.texture, at, end, rounding, 0.3 if file.missing else 1.0)
    if not file.texture:
        size = imgui.calc_text_size(Icon.PICTURE)
        middle = (round(at.x + (wide - size.x) / 2), round(at.y + (tall - size.y) / 2))
        canvas.add_text(middle, u32(PALETTE.field_hovered), Icon.PICTURE)
    if own and (file.missing or imgui.is_mouse_hovering_rect(at, end)):
        below = imgui.get_cursor_screen_pos()
        side = imgui.get_frame_height()
        corner = imgui.ImVec2(end.x - side - 4.0 * scale, at.y + 4.0 * scale)
        edge = (corner.x + side, corner.y + side)
        canvas.add_rect_filled(corner, edge, u32(PALETTE.scrim), rounding)
        imgui.set_cursor_screen_pos(corner)
        imgui.push_item_flag(_NO_NAV, True)  # the arrow keys move from card to card
        if icon_button("forget", Icon.CLOSE, ui):
            requested = [WithText("forget_file", str(file.path))]
        imgui.pop_item_flag()
        tip("Remove from this page (Del); the file stays")
        imgui.set_cursor_screen_pos(below)
    if hovered:
        canvas.add_rect(at, end, u32(PALETTE.accent), rounding, 2.0 * scale)
    name = file.title or escape_text(file.path.name.removesuffix(SUFFIX))
    imgui.text_colored(PALETTE.dim if file.missing else PALETTE.text, elide(name, wide))
    small(file.line, PALETTE.dim, wide)
    imgui.end_group()
    return requested


def folder_name(path: Path) -> str:
    """Return the file's folder on one printable line, with ~ for the user's home."""
    with suppress(ValueError, RuntimeError):
        return escape_text(f"~/{path.parent.relative_to(Path.home())}")
    return escape_text(str(path.parent))


def _dashed_frame(size: imgui.ImVec2, ui: UiContext) -> None:
    """Draw the dashed frame of the drop field. The whole window accepts dropped files."""
    scale = ui.scale
    dash = 7.0 * ui.scale
    x, y = imgui.get_cursor_screen_pos()
    imgui.dummy(size)
    x = x + scale
    y = y + scale
    wide = size.x - 2 * scale
    tall = size.y - 2 * scale
    canvas = imgui.get_window_draw_list()
    ink = u32(PALETTE.field_hovered)
    sides = ((x, y, wide, 1, 0), (x, y + tall, wide, 1, 0), (x, y, tall, 0, 1), (x + wide, y, tall, 0, 1))
    for left, top, length, dx, dy in sides:
        for i in range(int(length / (2 * dash)) + 1):
            low = 2 * i * dash
            high = min((2 * i + 1) * dash, length)
            begin = (left + dx * low, top + dy * low)
            end = (left + dx * high, top + dy * high)
            canvas.add_line(begin, end, ink, 1.5 * scale)


def draw_cover(work: Workspace, size: tuple[int, int], area: overlay.Area, ui: UiContext) -> None:
    """Draw the first cover image with the view's camera and size, unless a comparison is on."""
    view = work.view
    matching = [cover for cover in work.transient.covers if (cover.camera, cover.size) == (view.camera, size)]
    if not matching or view.compare.mode != "off":
        return
    cover = matching[0]
    corners = (0.0, 0.0), (area.width, area.height)
    imgui.get_background_draw_list().add_image(imgui.ImTextureRef(cover.texture), *corners)
    has_bar = view.panel and (work.shows_edit or work.transient.has_bar)
    overlay.banner(cover.name, area, ui, under_bar=has_bar)


_COLUMN_PX = 100.0


def draw_fields(kind: str, path: str, options: DeliverOptions, ui: UiContext) -> tuple[str, DeliverOptions]:
    """Draw the fields. Return the path with the suffix of the chosen format, and the changed options.

    Args:
        kind: "picture" or "film"
    """
    column = _COLUMN_PX * ui.scale
    options = _size_fields(options, column, ui)
    if kind == "picture":
        kinds = {False: "As shown", True: "Transparent"}
        return path, replace(options, alpha=choice_row("Background", kinds, options.alpha, column, ui))
    label("Moves", column)
    imgui.set_next_item_width(-1.0)
    titles = [film_title(name) for name in options.can_move]
    now = options.can_move.index(options.moves)
    pressed = drop_down("##moves", titles[now], titles, now, ui, "Animated slider or camera")
    options = options if pressed is None else replace(options, moves=options.can_move[pressed])
    label("Format", column)
    chosen = choice("format", FORMATS, options.format, ui)
    if chosen is not None:
        options = replace(options, format=chosen)
        path = str(Path(path).with_suffix(options.format)) if path.strip() else path
    paces = {fps: str(fps) for fps in FPS}
    options = replace(options, fps=choice_row("Frames/s", paces, options.fps, column, ui))
    if options.moves != "timeline":
        label("Seconds", column)
        imgui.set_next_item_width(-1.0)
        clamp = imgui.SliderFlags_.always_clamp.value
        changed, seconds = imgui.slider_float("##seconds", options.seconds, 1.0, 20.0, "%.0f s", clamp)
        options = replace(options, seconds=round(seconds)) if changed else options
        tip("Duration of the film")
    return path, options


def _size_fields(options: DeliverOptions, column: float, ui: UiContext) -> DeliverOptions:
    """Draw the fields for width and height and the buttons for common sizes; return the changed options."""
    label("Size", column)
    gap = 6.0 * ui.scale
    room = imgui.get_content_region_avail().x
    imgui.set_next_item_width(0.22 * room)
    _, width = imgui.input_int("##width", options.width, 0)
    imgui.same_line(0.0, gap)
    imgui.text_disabled("×")
    imgui.same_line(0.0, gap)
    imgui.set_next_item_width(0.22 * room)
    _, height = imgui.input_int("##height", options.height, 0)
    imgui.same_line(0.0, 2 * gap)
    size = min(max(width, 1), LARGEST_SIDE), min(max(height, 1), LARGEST_SIDE)
    shapes = tuple(SHAPES)
    side = min(size)
    shape = next((name for name in shapes if picture_size(side, name) == size), None)
    chosen_side = choice("size", {side: f"{side}p" for side in SIDES}, side if shape else None, ui)
    if chosen_side is not None:
        size = picture_size(chosen_side, shape or shapes[0])
    label("Shape", column)
    chosen = choice("shape", {name: name for name in shapes}, shape, ui)
    if chosen is not None:
        size = picture_size(side, chosen)
    return replace(options, width=size[0], height=size[1])
