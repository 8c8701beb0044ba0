"""Plot of ablations: a row per variant, a point per run with ± over the seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import LogLocator, NullLocator
from torch import Tensor

from trainer.report.plots import GRID, INK, LINES, PALE, PAPER

from .table import FIGURES, Ablation, Figure, VariantRow, rows_by_name

SHOWN = ("end", "between", "even", "s")
"""Figures that have a panel, by their short names."""

_DPI = 100
# inches
_ROW_HEIGHT = 0.21
_HEADER_HEIGHT = 1.0
_PLOT_WIDTH = 12.0


@dataclass(frozen=True)
class _Line:
    """A row of the plot."""

    name: str  # name of the variant
    of: str  # name of the variant that it differs from
    rows: Sequence[VariantRow | None]  # one per run; None if the variant makes no difference there


def plot_ablations(ablations: Sequence[Ablation]) -> Tensor:
    """Draw PSNR at the end and between, uniformity and processor time of every variant. [H,W,3], 0 to 1"""
    lines = [_Line(about.name, about.of, rows) for about, rows in rows_by_name(ablations)]
    drawing = Drawing(
        figsize=(_PLOT_WIDTH, _HEADER_HEIGHT + _ROW_HEIGHT * len(lines)), dpi=_DPI, facecolor=_hex(PAPER)
    )
    canvas = FigureCanvasAgg(drawing)
    figures = [figure for figure in FIGURES if figure.short in SHOWN]
    panels = drawing.subplots(1, len(figures), sharey=True, squeeze=False)[0]
    for panel, figure in zip(panels, figures, strict=True):
        _draw_panel(panel, figure, lines, [ablation.name for ablation in ablations])
    panels[0].set_yticks(range(len(lines)), [line.name for line in lines], fontsize=8, color=_hex(INK))
    panels[0].set_ylim(len(lines) - 0.4, -0.6)
    handles, labels = panels[0].get_legend_handles_labels()
    drawing.legend(handles, labels, loc="upper left", fontsize=9, frameon=False, ncols=len(labels))
    drawing.tight_layout()
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    return torch.from_numpy(pixels.astype(np.float32) / 255)


def _draw_panel(panel: Axes, figure: Figure, lines: Sequence[_Line], runs: Sequence[str]) -> None:
    """Draw one figure of all variants: points, ± over seeds, and a line from each one's reference variant."""
    panel.set_facecolor(_hex(PAPER))
    panel.set_title(figure.heading, fontsize=9, color=_hex(INK))
    panel.tick_params(colors=_hex(PALE), labelsize=8, length=0)
    panel.grid(axis="x", color=_hex(GRID), linewidth=0.8)
    for spine in panel.spines.values():
        spine.set_visible(False)
    if figure.short == "s":
        panel.set_xscale("log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_locator(NullLocator())
    for run, name in enumerate(runs):
        color = _hex(LINES[run % len(LINES)])
        shift = 0.16 * (2 * run - len(runs) + 1)
        found = {
            line.name: values
            for line in lines
            if (row := line.rows[run]) and (values := row.values(figure.of))
        }
        for row_index, line in enumerate(lines):
            if line.name in found:
                _draw_values(panel, row_index + shift, line, found, color)
        panel.plot([], [], "o", color=color, markersize=4, label=name)
    for row_index, line in enumerate(lines):
        if row_index and line.of == "base" and line.name in {other.of for other in lines}:
            panel.axhline(row_index - 0.5, color=_hex(PALE), linewidth=0.8)


def _draw_values(
    panel: Axes, place: float, line: _Line, found: Mapping[str, Sequence[float]], color: str
) -> None:
    values = found[line.name]
    mean = fmean(values)
    if line.of in found:
        panel.plot([fmean(found[line.of]), mean], [place, place], color=color, linewidth=1.0, alpha=0.45)
    spread = stdev(values) if len(values) > 1 else 0.0
    panel.errorbar(mean, place, xerr=spread, fmt="o", color=color, markersize=4, capsize=2, linewidth=1.6)


def _hex(color: tuple[int, int, int]) -> str:
    return "#" + "".join(f"{channel:02x}" for channel in color)
