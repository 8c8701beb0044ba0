"""Line plots, drawn with Pillow: curves over a common axis that can be read at their own size."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from PIL import Image, ImageDraw, ImageFont

PAPER, INK, PALE, GRID = (250, 249, 246), (38, 36, 34), (118, 113, 107), (228, 225, 219)
LINES = ((34, 84, 180), (214, 96, 36), (60, 150, 90), (150, 70, 160), (196, 158, 28), (70, 160, 180))

_ZOOM = 2  # drawn at twice the size and scaled down, for smooth edges
_MARKED = 20  # lines of at most so many points show them
_DECADES = 4  # a logarithmic axis shows no more, the least values lie on its floor

Points = tuple[Sequence[float], Sequence[float]]
"""xs and ys; what is not finite leaves a gap."""


@dataclass(frozen=True)
class Plot:
    """Curves over one axis.

    Args:
        title: what is shown, with its unit
        lines: name → points, in the order of the colours
        across: name of the axis below, "" for none
        scale: of the axis at the left; "log" needs values above 0, others are left out
        form: "lines", or "bars" side by side from 0
        low, high: what the axis at the left shows at least; None is as the values are
        span: what the axis below shows at least
    """

    title: str
    lines: Mapping[str, Points]
    across: str = ""
    scale: Literal["linear", "log"] = "linear"
    form: Literal["lines", "bars"] = "lines"
    low: float | None = None
    high: float | None = None
    span: tuple[float, float] | None = None


def draw_plot(plot: Plot, width: int, height: int) -> Image.Image:
    """The plot as a picture. `width` × `height` in pixels, at least 200 × 150."""
    zoom = _ZOOM
    page = Image.new("RGB", (width * zoom, height * zoom), PAPER)
    draw = ImageDraw.Draw(page)
    font, small = ImageFont.load_default(size=14 * zoom), ImageFont.load_default(size=12 * zoom)
    draw.text((14 * zoom, 16 * zoom), plot.title, INK, font, anchor="lm")
    lines = {name: _finite(points, plot.scale) for name, points in plot.lines.items()}
    lines = {name: points for name, points in lines.items() if points}
    legend = _legend(draw, list(lines), small, width * zoom)
    top = (40 + 18 * (legend[-1][2] + 1 if legend else 0)) * zoom
    bottom = (height - (46 if plot.across else 30)) * zoom
    if not lines:
        middle = (width * zoom / 2, (top + bottom) / 2)
        draw.text(middle, "nothing to show", PALE, small, anchor="mm")
        return page.resize((width, height), Image.Resampling.LANCZOS)

    xs = [x for points in lines.values() for x, _ in points]
    ys = [y for points in lines.values() for _, y in points]
    low, high = _span(ys, plot)
    y_ticks = _decades(low, high) if plot.scale == "log" else ticks(low, high)
    x_ticks = (
        ticks(min(*xs, *(plot.span or xs)), max(*xs, *(plot.span or xs))) if plot.form == "lines" else []
    )
    names = [_number(y) for y in y_ticks]
    left = 22 * zoom + max(draw.textlength(name, small) for name in names)
    right = (width - 16) * zoom
    x_low, x_high = (x_ticks[0], x_ticks[-1]) if x_ticks else (min(xs), max(xs))

    def place_x(x: float) -> float:
        return left + (x - x_low) / max(x_high - x_low, 1e-12) * (right - left)

    def place_y(y: float) -> float:
        a, b, y = (math.log(v) if plot.scale == "log" else v for v in (y_ticks[0], y_ticks[-1], y))
        return bottom - (min(max(y, a), b) - a) / (b - a) * (bottom - top)

    for y, name in zip(y_ticks, names, strict=True):
        draw.line([(left, place_y(y)), (right, place_y(y))], GRID, zoom)
        draw.text((left - 6 * zoom, place_y(y)), name, PALE, small, anchor="rm")
    for x in x_ticks:
        draw.text((place_x(x), bottom + 12 * zoom), _number(x), PALE, small, anchor="mm")
    if plot.across:
        draw.text(((left + right) / 2, bottom + 31 * zoom), plot.across, PALE, small, anchor="mm")
    for (name, at, row), color in zip(legend, LINES, strict=False):
        y = (40 + 18 * row) * zoom
        draw.line([(at, y), (at + 14 * zoom, y)], color, 3 * zoom)
        draw.text((at + 19 * zoom, y), name, INK, small, anchor="lm")
    for color, points in zip(LINES, lines.values(), strict=False):
        if plot.form == "bars":
            slot = (right - left) / len(points)
            for i, (_, y) in enumerate(points):
                x0, x1 = left + (i + 0.14) * slot, left + (i + 0.86) * slot
                draw.rectangle((x0, place_y(y), x1, bottom), color)
            continue
        marks = [(place_x(x), place_y(y)) for x, y in points]
        draw.line(marks, color, 2 * zoom, joint="curve")
        if len(marks) <= _MARKED:
            for x, y in marks:
                draw.ellipse([x - 3 * zoom, y - 3 * zoom, x + 3 * zoom, y + 3 * zoom], color)
    return page.resize((width, height), Image.Resampling.LANCZOS)


def ticks(low: float, high: float) -> list[float]:
    """Round numbers that enclose a range, about five steps apart."""
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    rough = (high - low) / 5
    power = 10 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= rough * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(i * step, 10) for i in range(first, last + 1)]


def _finite(points: Points, scale: str) -> list[tuple[float, float]]:
    pairs = zip(*points, strict=True)
    return [(x, y) for x, y in pairs if math.isfinite(y) and (y > 0 or scale == "linear")]


def _span(ys: Sequence[float], plot: Plot) -> tuple[float, float]:
    low = min(ys) if plot.low is None else min(plot.low, *ys)
    high = max(ys) if plot.high is None else max(plot.high, *ys)
    if plot.form == "bars":
        low = min(0.0, low)
    return low, high


def _decades(low: float, high: float) -> list[float]:
    """1, 2, 5 in every decade, or the decades alone where there are many; they enclose the range."""
    last = math.ceil(math.log10(high))
    first = max(math.floor(math.log10(low)), last - _DECADES)
    steps = (1, 2, 5) if last - first <= 2 else (1,)
    marks = [m * 10.0**power for power in range(first, last + 1) for m in steps]
    start = max((m for m in marks if m <= low * (1 + 1e-9)), default=marks[0])
    end = min((m for m in marks if m >= high * (1 - 1e-9) and m > start), default=10.0 * marks[-1])
    return [m for m in marks if start <= m <= end] or [start, end]


def _legend(
    draw: ImageDraw.ImageDraw,
    names: Sequence[str],
    font: ImageFont.FreeTypeFont | ImageFont.ImageFont,
    width: int,
) -> list[tuple[str, float, int]]:
    """Name, its place across and its row; a new row where the next one would not fit. One line needs none."""
    if len(names) < 2:
        return []
    placed: list[tuple[str, float, int]] = []
    at, row = 14.0 * _ZOOM, 0
    for name in names:
        needed = draw.textlength(name, font) + 19 * _ZOOM
        if placed and at + needed > width - 8 * _ZOOM:
            at, row = 14.0 * _ZOOM, row + 1
        placed.append((name, at, row))
        at += needed + 16 * _ZOOM
    return placed


def _number(value: float) -> str:
    return f"{value:.4g}"
