"""Widgets of the panel: headings, labels, tooltips, icon buttons, rows of choices, elided text."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeVar

from imgui_bundle import imgui, imgui_ctx

from viewer.state.commands import Action
from viewer.state.workspace import Layout

from .context import BEHIND, CARD_PADDING_PX, FIXED, PALETTE, SMALL_PX, UNFOCUSED, Icon, Rgba, UiContext, u32
from .keys import COMMANDS, NUDGES, describe, shortcut
from .search import jump_to
from .tips import show_tip, wrap

T = TypeVar("T")

MenuItems = Sequence[str | tuple[str, Action | None, str]]
IconItems = Sequence[tuple[str, str] | tuple[str, str, str]]
SEPARATOR_PX = 1.0  # height of a line across a list or the panel, at any scale
LINE_PX = 300.0  # width of the small text in a list's entry, at 1×
MOVING_OPACITY = 0.6  # of the plates over the picture while a slider moves
_GRIP_PX = 4.0  # a press that moves no further is a click, at 1×


def section(name: str, layout: Layout, ui: UiContext) -> Layout:
    """Draw the heading of a section with an arrow; return the layout with the new fold state."""
    x, y = imgui.get_cursor_screen_pos()
    with imgui_ctx.push_font(ui.fonts.bold, SMALL_PX):
        text = name.upper()
        tall = imgui.get_frame_height()
        step = 16.0 * ui.scale
        room = (imgui.calc_text_size(text).x + step, tall + 2.0 * ui.scale)
        pressed = imgui.invisible_button(f"section {name}", room, imgui.ButtonFlags_.enable_nav.value)
        color = u32(PALETTE.text if imgui.is_item_hovered() else PALETTE.dim)
        canvas = imgui.get_window_draw_list()
        canvas.add_text((round(x + step), round(y + 5.0 * ui.scale)), color, text)
    folded = layout.folded
    arrow = Icon.FOLDED if name in folded else Icon.UNFOLDED
    canvas.add_text((round(x), round(y + 4.0 * ui.scale)), color, arrow)
    if not pressed:
        return layout
    others = tuple(other for other in folded if other != name)
    return replace(layout, folded=others if name in folded else (*folded, name))


def right_edge() -> float:
    """Return the end of the line in the coordinates of `same_line`; call it at the line's start."""
    return float(imgui.get_cursor_pos_x() + imgui.get_content_region_avail().x)


def label(text: str, column: float) -> None:
    """Draw a name at the left; the next item begins at `column`."""
    imgui.align_text_to_frame_padding()
    imgui.text_disabled(text)
    imgui.same_line(column)


def small(text: str, color: Rgba, room: float | None = None) -> None:
    """Draw small text, elided to `room` window pixels, or to the line."""
    with imgui_ctx.push_font(None, SMALL_PX):
        room = imgui.get_content_region_avail().x if room is None else room
        imgui.text_colored(color, elide(text, room))


def wrapped_text(text: str, color: Rgba) -> None:
    """Draw small text, wrapped to the line."""
    with imgui_ctx.push_font(None, SMALL_PX), imgui_ctx.push_text_wrap_pos(0.0):
        imgui.text_colored(color, text)


def picture(
    texture: int, at: imgui.ImVec2Like, end: imgui.ImVec2Like, rounding: float, opacity: float = 1.0
) -> None:
    """Draw a texture by its GL name, or an empty card for 0."""
    canvas = imgui.get_window_draw_list()
    if not texture:
        canvas.add_rect_filled(at, end, u32(PALETTE.card), rounding)
        return
    corners = ((0.0, 0.0), (1.0, 1.0))
    white = u32((1.0, 1.0, 1.0, opacity))
    canvas.add_image_rounded(imgui.ImTextureRef(texture), at, end, *corners, white, rounding)


@contextmanager
def inert(when: bool) -> Iterator[None]:
    """Disable the enclosed items if `when` is true: they are dim and take no input."""
    imgui.begin_disabled(when)
    yield  # after an exception, `UiContext.guard` closes the open items
    imgui.end_disabled()


@contextmanager
def card(
    name: str, color: Rgba, ui: UiContext, nav: bool = False, padding: tuple[float, float] = CARD_PADDING_PX
) -> Iterator[None]:
    """Draw the enclosed items on a card of their height. `nav`: the keyboard navigates within it."""
    imgui.push_style_color(imgui.Col_.child_bg, color)
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(*padding) * ui.scale)
    child = imgui.ChildFlags_
    flags = child.auto_resize_y.value | child.always_use_window_padding.value
    flags |= 0 if nav else ui.child_flags("panel")
    imgui.begin_child(name, (0.0, 0.0), flags, 0 if nav else ui.nav_flags("panel"))
    imgui.pop_style_var()  # here, as tooltips and menus have their own padding
    yield  # after an exception, `UiContext.guard` closes the open items
    imgui.end_child()
    imgui.pop_style_color()


@contextmanager
def plate(
    name: str,
    at: imgui.ImVec2Like,
    ui: UiContext,
    pivot: tuple[float, float] = (0.0, 0.0),
    pad: float = CARD_PADDING_PX[0],
    size: imgui.ImVec2Like | None = None,
) -> Iterator[None]:
    """Draw the enclosed items on a plate over the picture. `size` None fits the content."""
    imgui.set_next_window_pos(at, 0, pivot)
    imgui.set_next_window_size(size or (0.0, 0.0))
    imgui.push_style_color(imgui.Col_.window_bg, PALETTE.scrim)
    alpha = imgui.get_style().alpha * (MOVING_OPACITY if ui.is_sliding else 1.0)
    imgui.push_style_var(imgui.StyleVar_.alpha, alpha)
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 4.0 * ui.scale)
    imgui.push_style_var(imgui.StyleVar_.window_padding, (pad * ui.scale, pad * ui.scale))
    fits = imgui.WindowFlags_.always_auto_resize.value if size is None else 0
    imgui.begin(name, None, FIXED | UNFOCUSED | BEHIND | fits | ui.nav_flags(name))
    imgui.pop_style_var(2)
    imgui.pop_style_color()
    ui.take_keyboard(name)
    yield  # after an exception, `UiContext.guard` closes the open items
    imgui.end()
    imgui.pop_style_var()


def accent_button(text: str, size: imgui.ImVec2Like, chord: str = "") -> bool:
    """Draw the button of the main action, with its keys at the right; return True if it was pressed."""
    col = imgui.Col_
    colors = {col.button: PALETTE.accent, col.button_hovered: PALETTE.handle, col.text: PALETTE.ink}
    for slot, color in colors.items():
        imgui.push_style_color(slot, color)
    pressed = imgui.button(text, size)
    if chord:
        padding = imgui.get_style().frame_padding
        with imgui_ctx.push_font(None, SMALL_PX):
            wide, tall = imgui.calc_text_size(chord)
            high, low = imgui.get_item_rect_min(), imgui.get_item_rect_max()
            at = (low.x - wide - padding.x, (high.y + low.y - tall) / 2)
            imgui.get_window_draw_list().add_text(at, u32(PALETTE.ink), chord)
    imgui.pop_style_color(len(colors))
    return bool(pressed)


def tip(text: str) -> None:
    """Show a tooltip of the last item on hover."""
    show_tip(text)


def tip_once(text: str, ui: UiContext) -> None:
    """Show a tooltip of the last item until it closes, once per session for all items with this text."""
    frame = imgui.get_frame_count()
    if frame - ui.known_tips.get(text, frame) <= 1 and show_tip(text):
        ui.known_tips[text] = frame


def checkbox(text: str, on: bool, ui: UiContext) -> bool:
    """Draw a check box, with an outline that shows it on any background; return its state."""
    imgui.push_style_var(imgui.StyleVar_.frame_border_size, ui.scale)
    imgui.push_style_color(imgui.Col_.border, PALETTE.faint)
    on = bool(imgui.checkbox(text, on)[1])
    imgui.pop_style_color()
    imgui.pop_style_var()
    return on


def icon_button(
    name: str, icon: str, ui: UiContext, dim: bool = False, lit: bool = False, side: float = 0.0
) -> bool:
    """Draw a square icon button; return True if it was pressed.

    Args:
        dim: its setting is off
        lit: its tool is active, or its setting is on
        side: window pixels; 0 for the height of a text field
    """
    side = side or imgui.get_frame_height()
    x, y = imgui.get_cursor_screen_pos()
    pressed = bool(imgui.invisible_button(name, (side, side), imgui.ButtonFlags_.enable_nav.value))
    hovered = imgui.is_item_hovered()
    canvas = imgui.get_window_draw_list()
    size = imgui.calc_text_size(icon)
    if hovered or lit:
        background = u32(PALETTE.chosen if lit else PALETTE.field)
        canvas.add_rect_filled((x, y), (x + side, y + side), background, 4.0 * ui.scale)
    color = PALETTE.faint if dim else PALETTE.text
    if hovered or lit:
        color = PALETTE.handle
    at = (round(x + (side - size.x) / 2), round(y + (side - size.y) / 2))
    canvas.add_text(at, u32(color), icon)
    return pressed


def hint(command: str, more: str = "") -> None:
    """Show the tooltip of the last item's command, followed by `more`."""
    tip(describe(command, more))


def empty_line(text: str, commands: Sequence[str], ui: UiContext, actions: list[Action]) -> None:
    """Draw the line of an empty list: its state, and a button for each command that fills it."""
    imgui.align_text_to_frame_padding()
    imgui.text_disabled(text)
    for i, command in enumerate(commands):
        imgui.same_line(0.0, 8.0 * ui.scale)
        name = COMMANDS[command].name.removesuffix("…")
        if imgui.button(name) if i else accent_button(name, (0.0, 0.0)):
            actions.append(COMMANDS[command].action)
        hint(command)


def icon_row(
    items: IconItems, ui: UiContext, actions: list[Action], gap: float = 0.0, off: Collection[str] = ()
) -> None:
    """Draw the buttons of commands on a line; those in `off` are disabled."""
    for i, (command, icon, *more) in enumerate(items):
        if i:
            imgui.same_line(0.0, gap)
        with inert(command in off):
            if icon_button(command, icon, ui):
                actions.append(COMMANDS[command].action)
        hint(command, *more)


def more_button(
    name: str,
    items: MenuItems,
    ui: UiContext,
    actions: list[Action],
    icon: str = Icon.MENU,
    side: float = 0.0,
) -> None:
    """Draw a button that opens a menu, see `menu_items`; append the chosen action to `actions`."""
    if icon_button(name, icon, ui, side=side):
        imgui.open_popup(name)
    actions += [action for action in menu_items(name, items, ui) if action is not None]


def menu_items(name: str, items: MenuItems, ui: UiContext, off: Collection[str] = ()) -> list[Action | None]:
    """Draw the menu that `imgui.open_popup(name)` opens; return the chosen action, if any.

    Args:
        items: commands of the table, "" for a line, or text, action and tooltip of another item
        off: disabled commands, and texts of disabled items
    """
    requested: list[Action | None] = []
    with menu(name, ui) as is_open:
        for item in items if is_open else ():
            if not item:
                imgui.separator()
            elif isinstance(item, str):
                if menu_item(item, enabled=item not in off):
                    requested.append(COMMANDS[item].action)
            else:
                text, action, help_ = item
                if imgui.menu_item(f"{text}##{action}", "", False, text not in off)[0]:
                    requested.append(action)
                if help_:
                    tip(help_)
    return requested


def menu_item(command: str, on: bool = False, enabled: bool = True, name: str = "") -> bool:
    """Draw a command with its key in an open menu; return True if it was chosen.

    Args:
        on: it has a check mark
        name: replaces the name in the table
    """
    row = COMMANDS[command]
    chosen = imgui.menu_item(f"{name or row.name}##{command}", shortcut(command), on, enabled)[0]
    if row.help:
        tip(row.help)
    return bool(chosen)


def typed_name(name: str, room: float) -> str | None:
    """Draw a text field for a name; return None while it is open, "" if the name is unchanged."""
    storage = imgui.get_state_storage()
    slot = int(imgui.get_id("name/focused"))
    if not storage.get_bool(slot):
        imgui.set_keyboard_focus_here()
        storage.set_bool(slot, True)
    imgui.set_next_item_width(room)
    flags = imgui.InputTextFlags_.enter_returns_true.value | imgui.InputTextFlags_.auto_select_all.value
    entered, text = imgui.input_text("##name", name, flags)
    if not (entered or imgui.is_item_deactivated()):
        return None
    storage.set_bool(slot, False)
    return text if entered or imgui.is_item_deactivated_after_edit() else ""


def start_naming(starts: bool = True) -> None:
    """Open the text field of a name, or close it."""
    imgui.get_state_storage().set_bool(imgui.get_id("naming"), starts)


def name_field(name: str, room: float, rename: Callable[[str], Action], actions: list[Action]) -> bool:
    """Draw the text field of a name if `start_naming` opened it, and return whether it did.

    Args:
        rename: returns the command for a typed name
    """
    if not imgui.get_state_storage().get_bool(imgui.get_id("naming")):
        return False
    typed = typed_name(name, room)
    start_naming(typed is None)
    if typed:
        actions.append(rename(typed))
    return True


def search_field(hint_: str, query: str) -> str:
    """Draw the search field above a list, focused when it appears; return its text."""
    if imgui.is_window_appearing():
        imgui.set_keyboard_focus_here()
    imgui.set_next_item_width(-1.0)
    return str(imgui.input_text_with_hint("##search", hint_, query)[1])


@contextmanager
def menu(name: str, ui: UiContext, flags: int = 0) -> Iterator[bool]:
    """Draw the context menu that `imgui.open_popup(name)` opens; yield whether it is open."""
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(*CARD_PADDING_PX) * ui.scale)
    is_open = imgui.begin_popup(name, flags)
    imgui.pop_style_var()
    yield bool(is_open)  # after an exception, `UiContext.guard` closes the open items
    if is_open:
        imgui.end_popup()


def drop_down(
    name: str,
    shown: str,
    titles: Sequence[str],
    current: int | None,
    ui: UiContext,
    help_: str,
    lines: Sequence[str] = (),
    faint: Collection[int] = (),
) -> int | None:
    """Draw a drop-down list; return the index of the chosen title, or None.

    Args:
        name: imgui id
        shown: text of the current choice
        titles: the choices
        current: index of the current choice
        help_: tooltip of the closed list
        lines: small text below each title, or none
        faint: indices of titles drawn in a faint color
    """
    flags = imgui.ComboFlags_.height_largest.value if lines else 0
    if not imgui.begin_combo(name, shown, flags):
        tip(help_)
        return None
    chosen = None
    storage = imgui.get_state_storage()
    slot = imgui.get_id("focused entry")
    letters = "".join(map(chr, imgui.get_io().input_queue_characters))
    jump = jump_to(letters, titles, storage.get_int(slot, -1 if current is None else current))
    for i, title in enumerate(titles):
        color = PALETTE.faint if i in faint else PALETTE.text
        if entry(title, lines[i] if lines else "", i == current, color, ui):
            chosen = i
        if i == current:
            imgui.set_item_default_focus()
        if i == jump:
            imgui.internal.focus_item()
            imgui.set_nav_cursor_visible(True)
            imgui.set_scroll_here_y(0.5)
        if i == jump or (jump is None and imgui.is_item_focused()):
            storage.set_int(slot, i)
    imgui.end_combo()
    return chosen


def entry(title: str, line: str, chosen: bool, color: Rgba, ui: UiContext) -> bool:
    """Draw an entry of an open list; return True if it was chosen.

    Args:
        title: text of the entry, unique in its list
        line: small text below it, wrapped; "" for none
        chosen: it is the current choice
        color: color of the title
    """
    imgui.push_style_color(imgui.Col_.text, color)
    if not line:
        pressed = imgui.selectable(title, chosen)[0]
        imgui.pop_style_color()
        return bool(pressed)
    with imgui_ctx.push_font(None, SMALL_PX):
        line = wrap(line, LINE_PX * ui.scale)
        below = imgui.calc_text_size(line)
    name = imgui.calc_text_size(title)
    pad = 2.0 * ui.scale
    wide = max(name.x, below.x)
    tall = name.y + below.y + 2 * pad
    x, y = imgui.get_cursor_screen_pos()
    imgui.dummy((wide, tall))  # a selectable is as wide as its list, and does not widen it
    imgui.set_cursor_screen_pos((x, y))
    pressed = imgui.selectable(f"##{title}", chosen, 0, (0.0, tall))[0]
    canvas = imgui.get_window_draw_list()
    canvas.add_text((x, round(y + pad)), u32(color), title)
    with imgui_ctx.push_font(None, SMALL_PX):
        canvas.add_text((x, round(y + pad + name.y)), u32(PALETTE.dim), line)
    imgui.pop_style_color()
    return bool(pressed)


def is_released() -> bool:
    """Return whether the mouse released the last item in this frame; False if its drag was canceled."""
    return bool(imgui.is_item_deactivated() and imgui.is_mouse_released(imgui.MouseButton_.left.value))


def grip(ui: UiContext) -> str:
    """Return the gesture on the last item, a button: "clicked", or "dragged" and at the end "dropped".

    "" means no gesture, or a canceled drag.
    """
    moved = imgui.get_mouse_drag_delta(imgui.MouseButton_.left.value, _GRIP_PX * ui.scale)
    far = bool(moved.x or moved.y)
    if far and imgui.is_item_active():
        return "dragged"
    if not is_released():
        return ""
    return "dropped" if far else "clicked"


def is_entered() -> bool:
    """Return whether a key has just pressed the last item."""
    return bool(imgui.get_current_context().nav_activate_id == imgui.get_item_id() != 0)


def key_step(less: imgui.Key, more: imgui.Key) -> float:
    """Return the step of the last item, which has the keyboard, by two arrow keys. `NUDGES` has the step
    sizes."""
    io = imgui.get_io()
    step = 0.0
    for key, sign in ((less, -1.0), (more, 1.0)):
        imgui.internal.set_key_owner(key, imgui.get_item_id())  # otherwise they would move to another item
        if imgui.is_key_pressed(key):
            step += sign
    modifier = "Ctrl+" if io.key_ctrl else ""
    if io.key_shift:
        modifier = "Shift+"
    return step * dict(NUDGES)[modifier]


def is_double_clicked() -> bool:
    """Return whether the last item, a slider, was double-clicked, which resets it to its default.

    It deactivates the slider, which would otherwise follow the mouse again in the next frame.
    """
    left = imgui.MouseButton_.left.value
    if not (imgui.is_item_hovered() and imgui.is_mouse_double_clicked(left)):
        return False
    imgui.internal.clear_active_id()
    return True


def value_slider(
    name: str,
    value: float,
    ends: tuple[float, float],
    form: str,
    default: float,
    ui: UiContext,
    wide: float = 0.0,
) -> float:
    """Draw a field with its value as text and a bar along its lower edge; return the value.

    Ctrl+click opens a text field, a double click resets to `default`, and arrow keys move a focused field. A
    range with a positive lower end is logarithmic. The bar of a range with negative values starts at 0. A new
    value is rounded to two decimals. `wide`: window pixels, 0 for the rest of the line.
    """
    logarithmic = ends[0] > 0.0
    context = imgui.get_current_context()
    tabbed = context.nav_activate_flags & imgui.internal.ActivateFlags_.from_tabbing.value
    flags = imgui.SliderFlags_.always_clamp.value
    flags |= imgui.SliderFlags_.logarithmic.value if logarithmic else 0
    flags |= imgui.SliderFlags_.no_input.value if tabbed else 0  # otherwise Tab would open a text field
    imgui.set_next_item_width(wide or -1.0)
    for slot in (imgui.Col_.slider_grab, imgui.Col_.slider_grab_active):
        imgui.push_style_color(slot, (0.0, 0.0, 0.0, 0.0))
    changed, new = imgui.slider_float(name, value, *ends, form, flags)
    imgui.pop_style_color(2)
    if tabbed and imgui.is_item_activated():
        imgui.internal.clear_active_id()
    if is_double_clicked():
        changed = True
        new = default
    first, last, current = (math.log(x) if logarithmic else x for x in (*ends, new if changed else value))
    share = (current - first) / (last - first)
    if imgui.is_item_focused() and context.nav_cursor_visible and not imgui.is_item_active():
        step = key_step(imgui.Key.left_arrow, imgui.Key.right_arrow)
        if step:
            moved = first + (share + step) * (last - first)
            moved = math.exp(moved) if logarithmic else moved
            min_step = value + math.copysign(0.01, step)  # one unit in the displayed digits
            changed = True
            new = max(moved, min_step) if step > 0.0 else min(moved, min_step)
            new = min(max(new, ends[0]), ends[1])
    share = min(max(share, 0.0), 1.0)
    low = imgui.get_item_rect_min()
    high = imgui.get_item_rect_max()
    left = (low.x, high.y - 3.0 * ui.scale)
    end = (high.x, high.y)
    canvas = imgui.get_window_draw_list()
    canvas.add_rect_filled(left, end, u32(PALETTE.line), 2.0 * ui.scale)
    start = min(max(-first / (last - first), 0.0), 1.0) if ends[0] < 0.0 else 0.0
    span = (low.x + min(start, share) * (high.x - low.x), low.x + max(start, share) * (high.x - low.x))
    canvas.add_rect_filled((span[0], left[1]), (span[1], high.y), u32(PALETTE.accent), 2.0 * ui.scale)
    return round(new, 2) if changed else value  # imgui would round an unchanged value to float32


_BUTTON_COLORS = (imgui.Col_.button, imgui.Col_.button_hovered, imgui.Col_.button_active)


def choice(
    name: str, options: Mapping[T, str], current: T | None, ui: UiContext, wide: float = 0.0
) -> T | None:
    """Draw a row of joined buttons; return the chosen value, or None.

    `options` maps values to texts. `wide`: window pixels, 0 for the rest of the line.
    """
    gap = 2.0 * ui.scale
    room = (wide or imgui.get_content_region_avail().x) - gap * (len(options) - 1)
    widths = [room / len(options)] * len(options)
    texts = [imgui.calc_text_size(text).x for text in options.values()]
    if wide or max(texts) > widths[0]:  # the same margin for each instead of the same width
        widths = [text + (room - sum(texts)) / len(options) for text in texts]
    pressed = None
    with imgui_ctx.begin_group():
        imgui.push_style_var(imgui.StyleVar_.frame_padding, (0.0, imgui.get_style().frame_padding.y))
        for i, (option, text) in enumerate(options.items()):
            if i:
                imgui.same_line(0.0, gap)
            slots = _BUTTON_COLORS if option == current else ()
            for slot in slots:
                imgui.push_style_color(slot, PALETTE.chosen)
            if imgui.button(f"{text}##{name}", (widths[i], 0.0)):
                pressed = option
            imgui.pop_style_color(len(slots))
        imgui.pop_style_var()
    return pressed


def choice_row(
    title: str, options: Mapping[T, str], current: T, column: float, ui: UiContext, help_: str = ""
) -> T:
    """Draw a named row of joined buttons, see `choice`; return the current value."""
    label(title, column)
    pressed = choice(title, options, current, ui)
    if help_:
        tip(help_)
    return current if pressed is None else pressed


def group_digits(count: int) -> str:
    """Return a count with its digits grouped by a thin space, as in "12 345"."""
    return f"{count:,}".replace(",", "\u2009")


def with_added(total: int, added: int) -> str:
    """Return a number of Gaussians as text, as in "12 345 + 2 074" if edits have added some."""
    return group_digits(total - added) + (f" + {group_digits(added)}" if added else "")


def elide(text: str, room: float) -> str:
    """Return the text, elided with "…" to fit `room` window pixels in the current font, after a whole word
    if possible."""
    if imgui.calc_text_size(text).x <= room:
        return text
    text_so_far = text
    while text_so_far and imgui.calc_text_size(text_so_far + "…").x > room:
        text_so_far = text_so_far[:-1]
    whole = re.match(r".*\w(?=\W)", text_so_far + text[len(text_so_far) :][:1])
    return (whole[0] if whole else text_so_far.rstrip()) + "…"
