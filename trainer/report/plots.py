"""Plots of curves over a common axis, drawn by matplotlib at their final size in pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

# colors, sRGB 0 to 255: background, title, labels, grid lines, and the curves in order
PAPER = (250, 249, 246)
INK = (38, 36, 34)
PALE = (118, 113, 107)
GRID = (228, 225, 219)
LINES = ((34, 84, 180), (214, 96, 36), (60, 150, 90), (150, 70, 160), (196, 158, 28), (70, 160, 180))
_DASHES = ("-", "--", ":")  # the next style is used after each pass through the colors

_DPI = 100
# margins around the axes and height of one legend line, pixels
_LEFT = 56
_RIGHT = 16
_TOP = 30
_BOTTOM = 44
_LEGEND = 20
_MAX_MARKERS = 20  # lines with more points have no markers
_MAX_DECADES = 4  # a logarithmic axis shows at most this much of any line and cuts off lower values

Points = tuple[Sequence[float], Sequence[float]]
"""x and y values; points with non-finite y are left out."""


@dataclass(frozen=True)
class Plot:
    """Curves over one axis."""

    title: str  # quantity and unit
    lines: Mapping[str, Points]  # name → points, in the order of the colors
    across: str = ""  # name of the axis below, "" for none
    # scale of the left axis; "log" leaves out values of 0 and below
    scale: Literal["linear", "log"] = "linear"
    low: float | None = None  # value that the left axis includes; None fits the values
    span: tuple[float, float] | None = None  # range that the axis below includes


def draw_plot(plot: Plot, width: int, height: int) -> Image.Image:
    """Draw the plot as a picture. `width` × `height` in pixels, at least 200 × 150."""
    paper, ink, pale, grid = (_shade(color) for color in (PAPER, INK, PALE, GRID))
    figure = Figure((width / _DPI, height / _DPI), _DPI, facecolor=paper)
    axes = figure.add_subplot(facecolor=paper)
    axes.set_title(plot.title, loc="left", fontsize=10, color=ink)
    axes.set_xlabel(plot.across, fontsize=9, color=pale)
    axes.tick_params(which="both", length=0, labelsize=8.5, labelcolor=pale)
    axes.spines[:].set_visible(False)
    lines = {name: _drawable(points, plot.scale) for name, points in plot.lines.items()}
    lines = {name: points for name, points in lines.items() if points[0]}
    if not lines:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no data", color=pale, ha="center", transform=axes.transAxes)
        return _image(figure)
    for i, (name, (xs, ys)) in enumerate(lines.items()):
        color = _shade(LINES[i % len(LINES)])
        dash = _DASHES[i // len(LINES) % len(_DASHES)]
        marker = "o" if len(xs) <= _MAX_MARKERS else ""
        axes.plot(xs, ys, dash, color=color, linewidth=1.5, marker=marker, markersize=3.5, label=name)
    if all(float(x).is_integer() for xs, _ in lines.values() for x in xs):
        axes.locator_params("x", integer=True)
    axes.set_axisbelow(True)
    axes.grid(color=grid)
    if plot.scale == "log":
        lowest = min(max(ys) for _, ys in lines.values())
        axes.set_yscale("log")
        axes.set_ylim(bottom=max(axes.get_ylim()[0], lowest * 10.0**-_MAX_DECADES))
    # invisible points extend the axes to the required range
    axes.update_datalim([(x, 0.0) for x in plot.span or ()], updatey=False)
    axes.update_datalim([] if plot.low is None else [(0.0, plot.low)], updatex=False)
    if plot.scale == "linear":
        axes.autoscale_view()
    legend = 0
    if len(lines) > 1:
        columns = 2 if sum(map(len, lines)) > 30 else len(lines)
        legend = _LEGEND * -(-len(lines) // columns)
        figure.legend(
            loc="lower left",
            ncols=columns,
            fontsize=8,
            frameon=False,
            labelcolor=ink,
            handlelength=1.2,
        )
    below = _BOTTOM - 14 * (not plot.across) + legend
    figure.subplots_adjust(_LEFT / width, below / height, 1.0 - _RIGHT / width, 1.0 - _TOP / height)
    return _image(figure)


def _drawable(points: Points, scale: str) -> tuple[list[float], list[float]]:
    pairs = [
        (x, y) for x, y in zip(*points, strict=True) if math.isfinite(y) and (y > 0 or scale == "linear")
    ]
    return [x for x, _ in pairs], [y for _, y in pairs]


def _shade(color: tuple[int, int, int]) -> tuple[float, float, float]:
    red, green, blue = color
    return red / 255, green / 255, blue / 255


def _image(figure: Figure) -> Image.Image:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
