"""The fields of a question about a picture or a film, between its path and its buttons."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from imgui_bundle import imgui

from viewer.jobs.delivery import FORMAT_NAMES, FORMATS, FPS, SIZES, DeliverOptions
from viewer.ui.context import UiContext
from viewer.ui.widgets import choice, drop_down, label, tip

COLUMN_PX = 100.0
_LARGEST = 16_384


def draw(kind: str, path: str, options: DeliverOptions, ui: UiContext) -> tuple[str, DeliverOptions]:
    """The path with the suffix that fits, and the options as the hand leaves them.

    Args:
        kind: "picture" or "film"
    """
    column = COLUMN_PX * ui.scale
    options = _size(options, column, ui)
    if kind == "picture":
        label("Background", column)
        pressed = choice("alpha", ("As shown", "Transparent"), int(options.alpha), ui)
        return path, options if pressed is None else replace(options, alpha=pressed == 1)
    label("Moves", column)
    imgui.set_next_item_width(-1.0)
    titles, now = [_moves(name) for name in options.can_move], options.can_move.index(options.moves)
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


def _size(options: DeliverOptions, column: float, ui: UiContext) -> DeliverOptions:
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
    pressed = choice(
        "size", [f"{tall}p" for _, tall in SIZES], SIZES.index(size) if size in SIZES else None, ui
    )
    width, height = size if pressed is None else SIZES[pressed]
    return replace(options, width=width, height=height)


def _moves(name: str) -> str:
    return "The timeline" if name == "timeline" else f"The slider of {name}, there and back"
