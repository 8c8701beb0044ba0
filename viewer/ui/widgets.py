"""The panel's small parts: headings, labels, tips, icon buttons, rows of choices, text that fits."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeVar

from imgui_bundle import imgui, imgui_ctx

from viewer.state.workspace import Layout

from .context import BEHIND, FIXED, PALETTE, SMALL_PX, UNFOCUSED, Icon, Rgba, UiContext, u32
from .keys import COMMANDS, NUDGES, describe, shortcut

T = TypeVar("T")

MenuItems = Sequence[str | tuple[str, str, str]]
IconItems = Sequence[tuple[str, str] | tuple[str, str, str]]
_GRIP_PX = 4.0  # what moves no further is a click, at 1×


def section(name: str, layout: Layout, ui: UiContext) -> Layout:
    """The heading of a part of the panel, with an arrow; the layout with it folded or not, as it was left."""
    x, y = imgui.get_cursor_screen_pos()
    with imgui_ctx.push_font(ui.fonts.bold, SMALL_PX):
        text = name.upper()
        tall = imgui.get_frame_height()
        step = 16.0 * ui.scale
        room = (imgui.calc_text_size(text).x + step, tall + 2.0 * ui.scale)
        pressed = imgui.invisible_button(f"section {name}", room, imgui.ButtonFlags_.enable_nav.value)
        color = u32(PALETTE.text if imgui.is_item_hovered() else PALETTE.dim)
        canvas = imgui.get_window_draw_list()
        canvas.add_text((round(x + step), round(y + 6.0 * ui.scale)), color, text)
    folded = layout.folded
    arrow = Icon.FOLDED if name in folded else Icon.UNFOLDED
    canvas.add_text((round(x), round(y + 5.0 * ui.scale)), color, arrow)
    if not pressed:
        return layout
    others = tuple(other for other in folded if other != name)
    return replace(layout, folded=others if name in folded else (*folded, name))


def right_edge() -> float:
    """Where the line ends, in the coordinates of `same_line`; ask at the line's start."""
    return float(imgui.get_cursor_pos_x() + imgui.get_content_region_avail().x)


def label(text: str, column: float) -> None:
    """A name at the left; what follows begins at `column`."""
    imgui.align_text_to_frame_padding()
    imgui.text_disabled(text)
    imgui.same_line(column)


def small(text: str, color: Rgba, room: float | None = None) -> None:
    """Small text, shortened to `room` window pixels, or to the line."""
    with imgui_ctx.push_font(None, SMALL_PX):
        room = imgui.get_content_region_avail().x if room is None else room
        imgui.text_colored(color, elide(text, room))


def wrapped_text(text: str, color: Rgba) -> None:
    """Small text in as many lines as it takes."""
    with imgui_ctx.push_font(None, SMALL_PX), imgui_ctx.push_text_wrap_pos(0.0):
        imgui.text_colored(color, text)


def picture(
    texture: int, at: imgui.ImVec2Like, end: imgui.ImVec2Like, rounding: float, opacity: float = 1.0
) -> None:
    """A picture by its GL name; where there is none, 0, an empty card."""
    canvas = imgui.get_window_draw_list()
    if not texture:
        canvas.add_rect_filled(at, end, u32(PALETTE.card), rounding)
        return
    corners = ((0.0, 0.0), (1.0, 1.0))
    white = u32((1.0, 1.0, 1.0, opacity))
    canvas.add_image_rounded(imgui.ImTextureRef(texture), at, end, *corners, white, rounding)


@contextmanager
def inert(when: bool) -> Iterator[None]:
    """What is drawn within is dim and takes no input, or is as always."""
    imgui.begin_disabled(when)
    yield  # where this raises, the frame ends what is open
    imgui.end_disabled()


@contextmanager
def card(
    name: str, color: Rgba, ui: UiContext, nav: bool = False, padding: tuple[float, float] = (10.0, 8.0)
) -> Iterator[None]:
    """What is drawn within lies on a card of its own height; `nav`: the keyboard goes through it."""
    imgui.push_style_color(imgui.Col_.child_bg, color)
    imgui.push_style_var(imgui.StyleVar_.window_padding, imgui.ImVec2(*padding) * ui.scale)
    child = imgui.ChildFlags_
    flags = child.auto_resize_y.value | child.always_use_window_padding.value
    flags |= 0 if nav else ui.child_flags("panel")
    imgui.begin_child(name, (0.0, 0.0), flags, 0 if nav else ui.nav_flags("panel"))
    imgui.pop_style_var()  # here, as tips and menus have paddings of their own
    yield  # where this raises, the frame ends what is open
    imgui.end_child()
    imgui.pop_style_color()


@contextmanager
def plate(
    name: str,
    at: imgui.ImVec2Like,
    ui: UiContext,
    pivot: tuple[float, float] = (0.0, 0.0),
    pad: float = 8.0,
    size: imgui.ImVec2Like | None = None,
) -> Iterator[None]:
    """What is drawn within lies on a plate over the picture; `size`: as large as what is on it if None."""
    imgui.set_next_window_pos(at, 0, pivot)
    imgui.set_next_window_size(size or (0.0, 0.0))
    imgui.push_style_color(imgui.Col_.window_bg, PALETTE.scrim)
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 4.0 * ui.scale)
    imgui.push_style_var(imgui.StyleVar_.window_padding, (pad * ui.scale, pad * ui.scale))
    fits = imgui.WindowFlags_.always_auto_resize.value if size is None else 0
    imgui.begin(name, None, FIXED | UNFOCUSED | BEHIND | fits | ui.nav_flags(name))
    imgui.pop_style_var(2)
    imgui.pop_style_color()
    ui.take_keyboard(name)
    yield  # where this raises, the frame ends what is open
    imgui.end()


def accent_button(text: str, size: imgui.ImVec2Like) -> bool:
    """The button that one is most likely here for; True when it was pressed."""
    col = imgui.Col_
    colors = {col.button: PALETTE.accent, col.button_hovered: PALETTE.handle, col.text: PALETTE.ink}
    for slot, color in colors.items():
        imgui.push_style_color(slot, color)
    pressed = imgui.button(text, size)
    imgui.pop_style_color(len(colors))
    return bool(pressed)


def tip(text: str) -> None:
    """What the last item does, shown when the mouse rests on it."""
    flags = imgui.HoveredFlags_
    # no_nav_override: the tip of a field that merely has the keyboard would cover the next row
    rests = flags.for_tooltip.value | flags.allow_when_disabled.value | flags.no_nav_override.value
    if imgui.is_item_hovered(rests):
        imgui.set_tooltip(text)


def icon_button(
    name: str, icon: str, ui: UiContext, dim: bool = False, lit: bool = False, side: float = 0.0
) -> bool:
    """A square button of an icon alone; True when it was pressed.

    Args:
        dim: what it stands for is off
        lit: it is in the hand, or on
        side: window pixels; 0 for the height of a text field
    """
    side = side or imgui.get_frame_height()
    x, y = imgui.get_cursor_screen_pos()
    pressed = bool(imgui.invisible_button(name, (side, side), imgui.ButtonFlags_.enable_nav.value))
    hovered = imgui.is_item_hovered()
    canvas = imgui.get_window_draw_list()
    size = imgui.calc_text_size(icon)
    if hovered or lit:
        ground = u32(PALETTE.chosen if lit else PALETTE.field)
        canvas.add_rect_filled((x, y), (x + side, y + side), ground, 4.0 * ui.scale)
    color = PALETTE.handle if hovered or lit else PALETTE.faint if dim else PALETTE.text
    at = (round(x + (side - size.x) / 2), round(y + (side - size.y) / 2))
    canvas.add_text(at, u32(color), icon)
    return pressed


def hint(action: str, more: str = "") -> None:
    """The tip of a command that the last item asks for, and what there is to say beside."""
    tip(describe(action, more))


def icon_row(
    items: IconItems, ui: UiContext, actions: list[str], gap: float = 0.0, off: Collection[str] = ()
) -> None:
    """Buttons of commands on a line; those in `off` cannot be pressed."""
    for i, (action, icon, *more) in enumerate(items):
        if i:
            imgui.same_line(0.0, gap)
        with inert(action in off):
            actions += [action] * icon_button(action, icon, ui)
        hint(action, *more)


def more_button(
    name: str, items: MenuItems, ui: UiContext, actions: list[str], icon: str = Icon.MENU, side: float = 0.0
) -> None:
    """A button that opens a menu, see `menu_items`; what was chosen goes to `actions`."""
    if icon_button(name, icon, ui, side=side):
        imgui.open_popup(name)
    actions += menu_items(name, items, ui)


def menu_items(name: str, items: MenuItems, ui: UiContext, off: Collection[str] = ()) -> list[str]:
    """The menu that `imgui.open_popup(name)` opens; the action that was chosen in it, if one was.

    Args:
        items: commands of the table, a line for ""; or text, action and tip of what is none
        off: actions that cannot be chosen
    """
    asked: list[str] = []
    with menu(name, ui) as is_open:
        for item in items if is_open else ():
            if not item:
                imgui.separator()
            elif isinstance(item, str):
                asked += [item] * menu_item(item, enabled=item not in off)
            else:
                text, action, help_ = item
                if imgui.menu_item(f"{text}##{action}", "", False, action not in off)[0]:
                    asked.append(action)
                if help_:
                    tip(help_)
    return asked


def menu_item(action: str, on: bool = False, enabled: bool = True, name: str = "") -> bool:
    """A command in a menu that is open, with its key; True when it was chosen.

    Args:
        on: it has a check mark
        name: in place of that of the table
    """
    command = COMMANDS[action]
    chosen = imgui.menu_item(f"{name or command.name}##{action}", shortcut(action), on, enabled)[0]
    if command.help:
        tip(command.help)
    return bool(chosen)


def typed_name(name: str, room: float) -> str | None:
    """The text field of a name; None while it is open, "" where it was left as it was."""
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
    """In place of a name its text field from now on, or not."""
    imgui.get_state_storage().set_bool(imgui.get_id("naming"), starts)


def name_field(name: str, room: float, action: str, actions: list[str]) -> bool:
    """The text field of a name, where `start_naming` has asked for it, and whether it has; what was typed
    follows `action`."""
    if not imgui.get_state_storage().get_bool(imgui.get_id("naming")):
        return False
    typed = typed_name(name, room)
    start_naming(typed is None)
    actions += [f"{action}:{typed}"] if typed else []
    return True


def search_field(hint_: str, query: str) -> str:
    """The text field over a list, which has the keyboard as it appears; what is sought."""
    if imgui.is_window_appearing():
        imgui.set_keyboard_focus_here()
    imgui.set_next_item_width(-1.0)
    return str(imgui.input_text_with_hint("##search", hint_, query)[1])


@contextmanager
def menu(name: str, ui: UiContext, flags: int = 0) -> Iterator[bool]:
    """A context menu that `imgui.open_popup(name)` opens; whether it is open. `flags`: of its window"""
    imgui.push_style_var(imgui.StyleVar_.window_padding, (8.0 * ui.scale, 8.0 * ui.scale))
    is_open = imgui.begin_popup(name, flags)
    imgui.pop_style_var()
    yield bool(is_open)  # where this raises, the frame ends what is open
    if is_open:
        imgui.end_popup()


def drop_down(
    name: str,
    shown: str,
    titles: Sequence[str],
    current: int | None,
    ui: UiContext,
    help_: str,
    tips: Sequence[str] = (),
    faint: Collection[int] = (),
) -> int | None:
    """A list that opens below what it shows; the index that was chosen, or None.

    Args:
        name: for imgui, shown nowhere
        shown: of the present choice
        titles: to choose from
        current: which of them is chosen
        help_: the tip of the closed list
        tips: one for each title, or none
        faint: which titles are drawn so
        flags: of `imgui.ComboFlags_`
    """
    if not imgui.begin_combo(name, shown):
        tip(help_)
        return None
    chosen = None
    for i, title in enumerate(titles):
        imgui.push_style_color(imgui.Col_.text, PALETTE.faint if i in faint else PALETTE.text)
        if imgui.selectable(f"{title}##{i}", i == current)[0]:
            chosen = i
        imgui.pop_style_color()
        if i == current:
            imgui.set_item_default_focus()
        if tips:
            tip(tips[i])
    imgui.end_combo()
    return chosen


def is_released() -> bool:
    """Whether the mouse let go of the last item in this frame; not where its drag was called off."""
    return bool(imgui.is_item_deactivated() and imgui.is_mouse_released(imgui.MouseButton_.left.value))


def grip(ui: UiContext) -> str:
    """What the hand does with the last item, a button: "clicked", or "dragged" and at the end "dropped".

    "" for nothing, and where a drag was called off.
    """
    moved = imgui.get_mouse_drag_delta(imgui.MouseButton_.left.value, _GRIP_PX * ui.scale)
    far = bool(moved.x or moved.y)
    if far and imgui.is_item_active():
        return "dragged"
    return "" if not is_released() else "dropped" if far else "clicked"


def is_entered() -> bool:
    """Whether the keyboard has just pressed the last item."""
    return bool(imgui.get_current_context().nav_activate_id == imgui.get_item_id() != 0)


def key_step(less: imgui.Key, more: imgui.Key) -> float:
    """How far two arrow keys move the last item, which has the keyboard: as those of the focused layer do."""
    io = imgui.get_io()
    step = 0.0
    for key, sign in ((less, -1.0), (more, 1.0)):
        imgui.internal.set_key_owner(key, imgui.get_item_id())  # else they would lead to another item
        step += sign * bool(imgui.is_key_pressed(key))
    return step * dict(NUDGES)["Shift+" if io.key_shift else "Ctrl+" if io.key_ctrl else ""]


def is_double_clicked() -> bool:
    """Whether the last item, a slider, was double-clicked, which takes it back to its default.

    It lets go of the slider, which would follow the mouse again in the next frame.
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
    """A field with its value in words, and along its foot how far that is from end to end.

    Ctrl+click types, a double click goes back to `default`, arrows move it where it has the keyboard. A range
    over orders of magnitude is logarithmic. The value is as before, or what the field shows. `wide`: window
    pixels, 0 for the rest of the line
    """
    logarithmic = ends[0] > 0.0
    context = imgui.get_current_context()
    tabbed = context.nav_activate_flags & imgui.internal.ActivateFlags_.from_tabbing.value
    flags = imgui.SliderFlags_.always_clamp.value
    flags |= imgui.SliderFlags_.logarithmic.value if logarithmic else 0
    flags |= imgui.SliderFlags_.no_input.value if tabbed else 0  # else Tab would open a text field
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
    first, last, now = (math.log(x) if logarithmic else x for x in (*ends, new if changed else value))
    share = (now - first) / (last - first)
    if imgui.is_item_focused() and context.nav_cursor_visible and not imgui.is_item_active():
        step = key_step(imgui.Key.left_arrow, imgui.Key.right_arrow)
        if step:
            moved = first + (share + step) * (last - first)
            moved = math.exp(moved) if logarithmic else moved
            least = value + math.copysign(0.01, step)  # that the field shows
            changed = True
            new = max(moved, least) if step > 0.0 else min(moved, least)
            new = min(max(new, ends[0]), ends[1])
    share = min(max(share, 0.0), 1.0)
    low = imgui.get_item_rect_min()
    high = imgui.get_item_rect_max()
    left = (low.x, high.y - 3.0 * ui.scale)
    end = (high.x, high.y)
    canvas = imgui.get_window_draw_list()
    shut = (low.x + share * (high.x - low.x), high.y)
    canvas.add_rect_filled(left, end, u32(PALETTE.line), 2.0 * ui.scale)
    canvas.add_rect_filled(left, shut, u32(PALETTE.accent), 2.0 * ui.scale)
    return round(new, 2) if changed else value  # unchanged, imgui still rounds to float32


def choice(
    name: str, options: Mapping[T, str], current: T | None, ui: UiContext, wide: float = 0.0
) -> T | None:
    """A row of joined buttons, `wide` pixels or 0 for the rest of the line; the value that was chosen of
    `options`, which give each its text, or None."""
    gap = 2.0 * ui.scale
    room = (wide or imgui.get_content_region_avail().x) - gap * (len(options) - 1)
    widths = [room / len(options)] * len(options)
    texts = [imgui.calc_text_size(text).x for text in options.values()]
    if wide or max(texts) > widths[0]:  # the same margin for each instead of the same width
        widths = [text + (room - sum(texts)) / len(options) for text in texts]
    pressed = None
    with imgui_ctx.begin_group():
        imgui.push_style_var(imgui.StyleVar_.frame_padding, (0.0, 5.0 * ui.scale))
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
    """A named row of joined buttons, see `choice`; the value as it is now."""
    label(title, column)
    pressed = choice(title, options, current, ui)
    if help_:
        tip(help_)
    return current if pressed is None else pressed


def swatch(color: tuple[float, float, float], alpha: float, edge: bool, ui: UiContext) -> None:
    """A small square of a color on the present line; `edge`: with a line around it."""
    side = 12.0 * ui.scale
    tall = imgui.get_frame_height()
    x, y = imgui.get_cursor_screen_pos()
    top = y + (tall - side) / 2
    corners = (x, top), (x + side, top + side)
    imgui.dummy((side, tall))
    canvas = imgui.get_window_draw_list()
    canvas.add_rect_filled(*corners, u32((*color, alpha)), 3 * ui.scale)
    if edge:
        canvas.add_rect(*corners, u32(PALETTE.line), 3 * ui.scale)


_BUTTON_COLORS = (imgui.Col_.button, imgui.Col_.button_hovered, imgui.Col_.button_active)


def group_digits(count: int) -> str:
    """12345 as "12 345", with a thin space."""
    return f"{count:,}".replace(",", "\u2009")


def with_added(total: int, added: int) -> str:
    """So many Gaussians, as in "12 345 + 2 074" where edits have added some of them."""
    return group_digits(total - added) + (f" + {group_digits(added)}" if added else "")


def elide(text: str, room: float) -> str:
    """The text, shortened with "…" to fit `room` window pixels in the present font: after a whole word, where
    one fits."""
    if imgui.calc_text_size(text).x <= room:
        return text
    text_so_far = text
    while text_so_far and imgui.calc_text_size(text_so_far + "…").x > room:
        text_so_far = text_so_far[:-1]
    whole = re.match(r".*\w(?=\W)", text_so_far + text[len(text_so_far) :][:1])
    return (whole[0] if whole else text_so_far.rstrip()) + "…"
