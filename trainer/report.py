"""report.json and report.png: what a run reached, in figures and to look at."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from progdf.field import BakedField
from progdf.field.judge import sample_strengths
from progdf.pictures import contact_sheet, to_picture
from progdf.slider_statistics import SliderStatistics, slider_statistics
from trainer.fit import Fitted, field_figures
from trainer.judge import Judge
from trainer.losses import Perceptual
from trainer.objective import Losses

SHOWN = (0.0, 0.25, 0.5, 0.75, 1.0)

_PAPER, _INK, _PALE, _GRID = (250, 249, 246), (38, 36, 34), (118, 113, 107), (228, 225, 219)
_LINES = ((34, 84, 180), (214, 96, 36), (60, 150, 90), (150, 70, 160), (196, 158, 28))
_THUMBNAIL = 240

Lines = Mapping[str, tuple[Sequence[float], Sequence[float]]]
"""Name → xs and ys of a line."""


@dataclass(frozen=True)
class Measured:
    """Everything about the fitted field that the report tells, measured on held-out views.

    Args:
        fitted: the field and its baselines
        slider: how the slider feels
        between: strength → (the field's, the 2-keyframe slider's) PSNR to the editor's own picture
        edit: the finished edit against the editor's pictures
    """

    fitted: Fitted
    slider: SliderStatistics
    between: Mapping[float, tuple[float, float]]
    edit: Mapping[str, Any]


def measure(judge: Judge, fitted: Fitted, perceptual: Perceptual) -> Measured:
    """Measure the chosen field."""
    field, linear = fitted.chosen.field, fitted.baselines["keyframes2"].field
    slider = slider_statistics(lambda s: judge.pictures(field.offsets(s)), masks=judge.pixels)
    between = {
        s: (
            judge.psnr(judge.pictures(field.offsets(s)), pictures),
            judge.psnr(judge.pictures(linear.offsets(s)), pictures),
        )
        for s, pictures in sorted(judge.edited.items())
        if s < 1.0
    }
    finished = judge.pictures(field.offsets(1.0))
    edit = {
        "psnr_to_views": round(judge.psnr(finished, judge.edited[1.0]), 2),
        "lpips_to_views": round(judge.perceptual(finished, judge.edited[1.0], perceptual), 4),
        "perceptual": perceptual.name,
        "clip_direction": None,
    }
    return Measured(fitted, slider, between, edit)


def figures(measured: Measured, endpoint_error: float, outside_change: float) -> dict[str, Any]:
    """The part of report.json that depends on the field (see docs of the command line)."""
    fitted, slider = measured.fitted, measured.slider
    exact = {"endpoint_error": endpoint_error, "outside_change": outside_change}
    return {
        "field": {**field_figures(fitted.chosen), **exact, "target_met": fitted.met},
        "baselines": {name: field_figures(errors) for name, errors in fitted.baselines.items()},
        "slider": {
            "monotone": slider.monotone,
            "uniformity": round(slider.uniformity, 3),
            "largest_jump": round(slider.largest_jump, 5),
            "t50": round(slider.t50, 3),
            "t90": round(slider.t90, 3),
        },
        "between": {
            f"{s:g}": {"psnr": round(ours, 2), "keyframes2": round(linear, 2)}
            for s, (ours, linear) in measured.between.items()
        },
        "edit": dict(measured.edit),
    }


def report_picture(judge: Judge, measured: Measured, losses: Losses, title: str) -> Tensor:
    """Thumbnails over curves: ours, the editor's own and two keyframes at five strengths; then the errors.

    Args:
        judge: held-out views; the one that shows most of the region is pictured
        measured: see `Measured`
        losses: mean of every loss term per recording
        title: one line
    """
    fitted, slider = measured.fitted, measured.slider
    chosen, linear = fitted.chosen, fitted.baselines["keyframes2"]
    best = max(range(len(judge.pixels)), key=lambda i: int(judge.pixels[i].sum()))
    blank = torch.full((*judge.crops[best].size, 3), 0.94)

    def row(field: BakedField) -> list[Tensor]:
        return [_thumbnail(judge.pictures(field.offsets(s))[best]) for s in SHOWN]

    original = judge.crops[best].original().clamp(0, 1)
    own = [original if s == 0 else judge.edited[s][best] if s in judge.edited else blank for s in SHOWN]
    sheet = to_picture(
        contact_sheet(
            [row(chosen.field), [_thumbnail(image) for image in own], row(linear.field)],
            ["slider", "the editor", "2 keyframes"],
            [f"s = {s:g}" for s in SHOWN],
            title,
            f"held-out view {judge.names[best]}; grey: the editor was not asked",
        )
    )
    s = sample_strengths()
    fields = {chosen.field.kind: chosen, **fitted.baselines}
    plots: dict[str, Lines] = {
        "field against the recorded trajectory, dB": {
            f"{name}, {found.field.bytes_per_member:.0f} B": (s, found.curve)
            for name, found in fields.items()
        },
        "visible change along the slider": {
            "from the original": (_even(len(slider.distances)), slider.distances),
            "per 1/20 step": (
                [(i + 0.5) / len(slider.steps) for i in range(len(slider.steps))],
                slider.steps,
            ),
        },
    }
    if measured.between:
        at = list(measured.between)
        plots["against the editor's own picture, dB"] = {
            "slider": (at, [ours for ours, _ in measured.between.values()]),
            "2 keyframes": (at, [plain for _, plain in measured.between.values()]),
        }
    names = {"left": "L1 to the finished edit", "l1": "L1 to the stage"}
    plots["training: weighted loss terms over steps"] = {
        names.get(term, term): (
            [step for step, value in zip(losses["step"], column, strict=True) if step and value is not None],
            [value for value in column if value is not None],
        )
        for term, column in losses.items()
        if term != "step"
    }
    return _stacked(sheet, plots)


def _even(count: int) -> list[float]:
    return [i / (count - 1) for i in range(count)]


def _thumbnail(image: Tensor) -> Tensor:
    """Scaled into a white square, so that all views make one grid."""
    picture = to_picture(image)
    scale = _THUMBNAIL / max(picture.size)
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    page = Image.new("RGB", (_THUMBNAIL, _THUMBNAIL), "white")
    page.paste(
        picture.resize(size, Image.Resampling.LANCZOS),
        ((_THUMBNAIL - size[0]) // 2, (_THUMBNAIL - size[1]) // 2),
    )
    return torch.from_numpy(np.asarray(page, dtype=np.float32) / 255.0)


def _plot(title: str, lines: Lines, width: int, height: int = 260) -> Image.Image:
    """Lines over a common axis, drawn at twice the size and scaled down for smooth edges."""
    zoom = 2
    page = Image.new("RGB", (width * zoom, height * zoom), _PAPER)
    draw = ImageDraw.Draw(page)
    font, small = ImageFont.load_default(size=13 * zoom), ImageFont.load_default(size=11 * zoom)
    left, right, top, bottom = 46 * zoom, (width - 12) * zoom, 46 * zoom, (height - 24) * zoom
    xs = [x for points, _ in lines.values() for x in points]
    ys = [y for _, points in lines.values() for y in points if math.isfinite(y)]
    x_ticks, y_ticks = _ticks(min(xs), max(xs)), _ticks(min(ys), max(ys))
    (x_low, x_high), (y_low, y_high) = (x_ticks[0], x_ticks[-1]), (y_ticks[0], y_ticks[-1])

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - x_low) / (x_high - x_low)
        return left + across * (right - left), bottom - (y - y_low) / (y_high - y_low) * (bottom - top)

    draw.text((12 * zoom, 12 * zoom), title, _INK, font, anchor="lm")
    for y in y_ticks:
        draw.line([(left, place(x_low, y)[1]), (right, place(x_low, y)[1])], _GRID, zoom)
        draw.text((left - 5 * zoom, place(x_low, y)[1]), f"{y:g}", _PALE, small, anchor="rm")
    for x in x_ticks:
        draw.text((place(x, y_low)[0], bottom + 11 * zoom), f"{x:g}", _PALE, small, anchor="mm")
    at = left
    for color, (name, (points, values)) in zip(_LINES, lines.items(), strict=False):
        marks = [place(x, y) for x, y in zip(points, values, strict=True) if math.isfinite(y)]
        draw.line(marks, color, 2 * zoom, joint="curve")
        if len(marks) <= 25:
            for x, y in marks:
                draw.ellipse([x - 2 * zoom, y - 2 * zoom, x + 2 * zoom, y + 2 * zoom], color)
        draw.line([(at, 32 * zoom), (at + 14 * zoom, 32 * zoom)], color, 3 * zoom)
        draw.text((at + 19 * zoom, 32 * zoom), name, _INK, small, anchor="lm")
        at += round(draw.textlength(name, small)) + 34 * zoom
    return page.resize((width, height), Image.Resampling.LANCZOS)


def _ticks(low: float, high: float) -> list[float]:
    """Four to eight round numbers that enclose the range."""
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    rough = (high - low) / 5
    power = 10 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= rough)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(i * step, 10) for i in range(first, last + 1)]


def _stacked(sheet: Image.Image, plots: Mapping[str, Lines]) -> Tensor:
    """The sheet with the plots in rows below it."""
    columns = 3 if len(plots) % 2 else 2
    width = sheet.width // columns
    drawn = [_plot(title, lines, width) for title, lines in plots.items()]
    rows = -(-len(drawn) // columns)
    page = Image.new("RGB", (sheet.width, sheet.height + rows * drawn[0].height + 8), _PAPER)
    page.paste(sheet, (0, 0))
    for i, plot in enumerate(drawn):
        page.paste(plot, ((i % columns) * width, sheet.height + (i // columns) * plot.height))
    return torch.from_numpy(np.asarray(page, dtype=np.float32) / 255.0)
