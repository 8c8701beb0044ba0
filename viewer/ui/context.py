"""imgui context: fonts, colors, spacing, and one scale for high-density screens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from imgui_bundle import icons_fontawesome_6 as icons
from imgui_bundle import imgui

from .fonts import FallbackFonts, load_fonts
from .splash import ACCENT, FIELD, PANEL, TEXT, TEXT_PX

Rgba = tuple[float, float, float, float]

FONT_PX = TEXT_PX  # at 1×
SMALL_PX = 12.0

# Spacing is a multiple of 8, or of 4 within a control. Pairs are horizontal and vertical, at 1×.
GAP_PX = 8.0  # between controls, and from the window's edges
HALF_GAP_PX = 4.0  # between parts of a control
PANEL_PADDING_PX = (16.0, 8.0)
CARD_PADDING_PX = (8.0, 8.0)  # also of menus, tooltips and plates over the picture
LAYER_PADDING_PX = (8.0, 4.0)  # of a layer's card
FRAME_PADDING_PX = (8.0, 4.0)  # of buttons and fields


def _rgb(code: int, alpha: float = 1.0) -> Rgba:
    return (code >> 16 & 255) / 255, (code >> 8 & 255) / 255, (code & 255) / 255, alpha


@dataclass(frozen=True)
class Palette:
    """Colors of the interface: neutral grays, so that the picture's colors stay unaffected.

    The accent, the only blue, marks the likely action, values, and the item with the keyboard or the focus.
    tests/viewer/app/test_theme.py checks the contrasts.
    """

    panel: Rgba = _rgb(PANEL)
    card: Rgba = _rgb(0x282B30)
    card_focused: Rgba = _rgb(0x2F333A)
    field: Rgba = _rgb(FIELD)
    field_hovered: Rgba = _rgb(0x434850)
    field_active: Rgba = _rgb(0x4C525B)
    chosen: Rgba = _rgb(0x59606B)
    line: Rgba = _rgb(0x3A3E45)
    text: Rgba = _rgb(TEXT)
    dim: Rgba = _rgb(0xA6ACB6)
    faint: Rgba = _rgb(0x868D98)
    accent: Rgba = _rgb(ACCENT)
    ink: Rgba = _rgb(0x14161A)  # text on the accent
    handle: Rgba = _rgb(0xF2F4F7)
    success: Rgba = _rgb(0x7FC08A)
    error: Rgba = _rgb(0xF08674)
    warning: Rgba = _rgb(0xE0A44A)
    warning_dark: Rgba = _rgb(0x6E5632)
    scrim: Rgba = _rgb(0x16181B, 0.86)


PALETTE = Palette()
ROW_COLORS = tuple(map(_rgb, (0x7FC08A, 0xD9A441, 0xC792D6, 0xE08C7A, 0x5DBDB5, 0xB9BE5C)))
"""Colors of the timeline's rows: of similar lightness, and none close to the accent."""

FIXED = (
    imgui.WindowFlags_.no_decoration.value
    | imgui.WindowFlags_.no_move.value
    | imgui.WindowFlags_.no_saved_settings.value
)
"""Flags of a fixed part of the window, in addition to `UiContext.nav_flags`."""

BEHIND = imgui.WindowFlags_.no_bring_to_front_on_focus.value
UNFOCUSED = imgui.WindowFlags_.no_focus_on_appearing.value


class Icon:
    """Glyphs of the icon font that is merged into the text font."""

    SHOWN = icons.ICON_FA_EYE
    HIDDEN = icons.ICON_FA_EYE_SLASH
    UNDO = icons.ICON_FA_ROTATE_LEFT
    REDO = icons.ICON_FA_ROTATE_RIGHT
    HISTORY = icons.ICON_FA_CLOCK_ROTATE_LEFT
    PICTURE = icons.ICON_FA_CAMERA
    HELP = icons.ICON_FA_QUESTION
    FILM = icons.ICON_FA_FILM
    HOME = icons.ICON_FA_HOUSE
    FRAME = icons.ICON_FA_EXPAND
    LOCKED = icons.ICON_FA_LOCK
    UNLOCKED = icons.ICON_FA_LOCK_OPEN
    GAINS = icons.ICON_FA_SLIDERS
    MENU = icons.ICON_FA_ELLIPSIS_VERTICAL
    BRUSH = icons.ICON_FA_PAINTBRUSH
    COLOR_BRUSH = icons.ICON_FA_PALETTE
    CLONE = icons.ICON_FA_CLONE
    BOX = icons.ICON_FA_VECTOR_SQUARE
    LASSO = icons.ICON_FA_SIGNATURE
    POLYGON = icons.ICON_FA_DRAW_POLYGON
    SELECT_BRUSH = icons.ICON_FA_CIRCLE_DOT
    SCRIBBLE = icons.ICON_FA_HIGHLIGHTER
    SPHERE = icons.ICON_FA_GLOBE
    FLOOD = icons.ICON_FA_WAND_MAGIC_SPARKLES
    COLOR = icons.ICON_FA_EYE_DROPPER
    SUBJECT = icons.ICON_FA_CROSSHAIRS
    CLOSE = icons.ICON_FA_XMARK
    ORBIT = icons.ICON_FA_ARROWS_SPIN
    FLY = icons.ICON_FA_PAPER_PLANE
    MEASURE = icons.ICON_FA_RULER
    DECAL = icons.ICON_FA_STAMP
    MOVE = icons.ICON_FA_UP_DOWN_LEFT_RIGHT
    PULL = icons.ICON_FA_HAND_BACK_FIST
    SOLO = icons.ICON_FA_STAR
    SAVE = icons.ICON_FA_FLOPPY_DISK
    SHARE = icons.ICON_FA_ARROW_UP_FROM_BRACKET
    VIEW = icons.ICON_FA_CUBE
    TRAIN = icons.ICON_FA_PLAY
    BARS = icons.ICON_FA_BARS
    OPEN = icons.ICON_FA_FOLDER_OPEN
    FOLDED = icons.ICON_FA_CARET_RIGHT
    UNFOLDED = icons.ICON_FA_CARET_DOWN
    RAISED = icons.ICON_FA_CARET_UP
    SPLIT = icons.ICON_FA_CIRCLE_HALF_STROKE


class UiContext:
    """imgui context with its fonts and scale. Make it current before drawing; `close` it when done.

    Args:
        scale: window pixels per design pixel, ≥ 0.5; 1 on an ordinary screen
    """

    def __init__(self, scale: float = 1.0) -> None:
        self.context = imgui.create_context()
        imgui.set_current_context(self.context)
        io = imgui.get_io()
        io.set_ini_filename("")  # no imgui.ini left in the user's folder
        io.set_log_filename("")
        io.config_input_text_cursor_blink = False  # a blinking cursor would redraw the window all the time
        io.config_flags |= imgui.ConfigFlags_.nav_enable_keyboard.value  # in lists, menus and the form
        self.context.config_nav_windowing_key_next = self.context.config_nav_windowing_key_prev = 0
        self.keyboard = ""  # part of the window with the keyboard, "" for the picture
        self.focused = ""  # part that received the keyboard last
        self.is_sliding = False  # a strength slider of the panel is dragged
        self.known_tips: dict[str, int] = {}  # tooltips shown once per session, and their last frame
        self.job_slots: tuple[tuple[int, float], ...] = ()  # number and height of each job card
        self.fonts = load_fonts(io.fonts)
        self.fallbacks = FallbackFonts(io.fonts, self.fonts)
        self.scale = 0.0
        self.set_scale(scale)

    def make_current(self) -> None:
        imgui.set_current_context(self.context)

    def nav_flags(self, name: str) -> int:
        """Return window flags that allow keyboard navigation only in the part that has the keyboard."""
        return 0 if self.keyboard == name else imgui.WindowFlags_.no_nav.value

    def child_flags(self, name: str) -> int:
        """Return flags for a scrolling child of this part that let keyboard navigation cross its edge."""
        return imgui.ChildFlags_.nav_flattened.value if self.keyboard == name else 0

    def take_keyboard(self, name: str) -> None:
        """Focus the current window if its part has just received the keyboard."""
        if self.keyboard == name != self.focused:
            imgui.set_window_focus()
            imgui.internal.nav_init_window(imgui.internal.get_current_window(), True)
            imgui.set_nav_cursor_visible(True)
            self.focused = name

    def set_scale(self, scale: float) -> None:
        """Set fonts and spacing for this many window pixels per design pixel."""
        if scale != self.scale:
            self.scale = scale
            _apply_style(scale)

    @contextmanager
    def guard(self, report: Callable[[Exception], None]) -> Iterator[None]:
        """Run a part of a frame. An exception ends only this part and restores imgui's stacks."""
        begun = imgui.internal.ErrorRecoveryState()
        drawing = imgui.get_current_context().within_frame_scope
        if drawing:
            imgui.internal.error_recovery_store_state(begun)
        try:
            yield
        except Exception as error:
            if drawing:
                _silence_imgui(True)  # `report` shows the error, so imgui need not list the open items
                imgui.internal.error_recovery_try_to_recover_state(begun)
                _silence_imgui(False)
            report(error)

    def close(self) -> None:
        imgui.destroy_context(self.context)


def _silence_imgui(silent: bool) -> None:
    """Turn off imgui's own reports about unclosed items."""
    io = imgui.get_io()
    io.config_error_recovery_enable_assert = not silent
    io.config_error_recovery_enable_debug_log = not silent
    io.config_error_recovery_enable_tooltip = not silent


def _apply_style(scale: float) -> None:
    style = imgui.get_style()
    style.font_size_base = FONT_PX
    style.font_scale_dpi = scale
    for name, (x, y) in {
        "window_padding": CARD_PADDING_PX,
        "frame_padding": FRAME_PADDING_PX,
        "item_spacing": (GAP_PX, GAP_PX),
        "item_inner_spacing": (GAP_PX, HALF_GAP_PX),
        "cell_padding": (GAP_PX, HALF_GAP_PX),
    }.items():
        setattr(style, name, (x * scale, y * scale))
    for name, size in {
        "frame_rounding": 4,
        "popup_rounding": 4,
        "child_rounding": 4,
        "grab_rounding": 4,
        "grab_min_size": 10,
        "scrollbar_size": 10,
        "scrollbar_rounding": 4,
        "window_rounding": 0,
    }.items():
        setattr(style, name, size * scale)
    style.window_border_size = style.child_border_size = style.frame_border_size = 0.0
    style.popup_border_size = 1.0
    style.disabled_alpha = 0.4
    style.hover_stationary_delay = 0.3
    style.hover_delay_normal = 0.5
    p = PALETTE
    col = imgui.Col_
    imgui.style_colors_dark()
    for slot, color in {
        col.window_bg: p.panel,
        col.child_bg: (0.0, 0.0, 0.0, 0.0),
        col.popup_bg: p.card,
        col.border: p.line,
        col.text: p.text,
        col.text_disabled: p.dim,
        col.frame_bg: p.field,
        col.frame_bg_hovered: p.field_hovered,
        col.frame_bg_active: p.field_active,
        col.button: p.field,
        col.button_hovered: p.field_hovered,
        col.button_active: p.field_active,
        col.header: p.field,
        col.header_hovered: p.field_hovered,
        col.header_active: p.field_active,
        col.slider_grab: p.handle,
        col.slider_grab_active: p.handle,
        col.check_mark: p.accent,
        col.separator: p.line,
        col.scrollbar_bg: (0.0, 0.0, 0.0, 0.0),
        col.scrollbar_grab: p.field,
        col.scrollbar_grab_hovered: p.field_hovered,
        col.scrollbar_grab_active: p.field_active,
        col.text_selected_bg: (*p.accent[:3], 0.4),
        col.nav_cursor: p.accent,
    }.items():
        style.set_color_(slot, color)


def u32(color: Rgba) -> int:
    """Return a color packed for draw lists."""
    return imgui.get_color_u32(color)
