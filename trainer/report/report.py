"""The picture report.png of a run; its figures come from `measures`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from progdf.field.choose import Field, sample_strengths
from progdf.io.images import contact_sheet, to_picture
from trainer.fit.evaluate import Evaluator
from trainer.optimize.losses import Losses
from trainer.report.measures import COMPARED, Direction, Measured

from .plots import PAPER, Plot, Points, draw_plot

SHOWN = (0.0, 0.25, 0.5, 0.75, 1.0)  # slider values of the columns

Columns = Sequence[tuple[float, float | None]]
"""Slider value of each picture and the strength of the editor's picture there; None without one."""

_SNAP_DISTANCE = 1 / 16  # a column moves to an editor picture within this distance on the slider
_SPAN = (0.0, 1.0)  # range of the slider axis
_THUMBNAIL_WIDTH = 240  # pixels
_PLOT_HEIGHT = 270  # pixels
_TERMS = {"left": "L1 to the finished edit", "l1": "L1", "perceptual": "LPIPS"}


def report_picture(
    evaluator: Evaluator, shown: Evaluator, measured: Measured, losses: Losses, title: str, held_out: int
) -> Tensor:
    """Draw thumbnails of the slider, the editor and two keyframes at five strengths, above plots of the
    errors.

    Args:
        evaluator: the evaluated views; the one that shows most of the region is drawn
        shown: the same with the Gaussians that the edit adds
        measured: see `Measured`
        losses: mean of every loss term per recording
        title: one line
        held_out: number of held-out views among the evaluated ones
    """
    chosen = measured.shown
    columns = columns_of(measured.asked)
    sheet = to_picture(
        contact_sheet(
            [
                strip(shown, chosen, columns),
                editor_strip(evaluator, columns),
                strip(evaluator, measured.keyframes, columns),
            ],
            ["slider", "the editor", "2 keyframes"],
            [column_heading(*column) for column in columns],
            title,
            view_caption(evaluator, held_out)
            + ("; gray: no editor picture" if any(at is None for _, at in columns[1:]) else ""),
        )
    )
    return stack_plots(sheet, [_error_plots(measured), _uniformity_plots(measured, losses)])


def view_caption(evaluator: Evaluator, held_out: int) -> str:
    """Return a caption that names the best view and states if all figures are of one view.

    Args:
        evaluator: the evaluated views
        held_out: number of held-out views among them
    """
    kind = ("view trained on,", "all figures are of one held-out view,", "held-out view")[min(held_out, 2)]
    return f"{kind} {evaluator.names[best_view(evaluator)]}"


def best_view(evaluator: Evaluator) -> int:
    """Return the index of the view that shows most of the region."""
    return max(range(len(evaluator.pixels)), key=lambda i: int(evaluator.pixels[i].sum()))


def columns_of(stages: Sequence[tuple[float, float]]) -> Columns:
    """Choose five slider values to draw: `SHOWN`, each moved to a close editor picture.

    Args:
        stages: slider value and strength of the editor's pictures, ascending, the last (1, 1)
    """
    columns: list[tuple[float, float | None]] = [(0.0, 0.0)]
    for s in SHOWN[1:]:
        at, strength = min(stages, key=lambda pair: abs(pair[0] - s))
        columns.append((at, strength) if abs(at - s) <= _SNAP_DISTANCE else (s, None))
    return columns


def strip(
    evaluator: Evaluator, field: Field, columns: Columns, width: int = _THUMBNAIL_WIDTH
) -> list[Tensor]:
    """Draw the best view at the columns' slider values, as thumbnails of one size."""
    best = best_view(evaluator)
    return [thumbnail(evaluator.picture(field.offsets(s), best), width) for s, _ in columns]


def editor_strip(evaluator: Evaluator, columns: Columns, width: int = _THUMBNAIL_WIDTH) -> list[Tensor]:
    """Draw the editor's pictures of the best view; gray in columns without one."""
    best = best_view(evaluator)
    blank = torch.full((*evaluator.crops[best].size, 3), 0.94)
    original = evaluator.crops[best].original.clamp(0, 1)
    edited = [original, *(blank if at is None else evaluator.edited[at][best] for _, at in columns[1:])]
    return [thumbnail(image, width) for image in edited]


def thumbnail(image: Tensor, width: int) -> Tensor:
    """Scale an image to a width, or less if it is tall, on a paper background. [H,W,3] -> [h,width,3]"""
    picture = to_picture(image)
    scale = min(width / picture.width, 1.25 * width / picture.height)
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    page = Image.new("RGB", (width, size[1]), PAPER)
    page.paste(picture.resize(size, Image.Resampling.LANCZOS), ((width - size[0]) // 2, 0))
    return torch.from_numpy(np.asarray(page, dtype=np.float32) / 255.0)


def _error_plots(measured: Measured) -> list[Plot]:
    """Plot errors of all measured fields against the recording, and of two fields against the editor."""
    edit = measured.edit
    s = [edit.remap.at(s) for s in sample_strengths()]
    fields = {edit.chosen.field.kind: edit.chosen, **edit.baselines}
    recorded: dict[str, Points] = {
        f"{_label(name)}, {found.field.bytes_per_member:.0f} B": (s, found.curve)
        for name, found in fields.items()
    }
    name = f"{_label(COMPARED)}, {measured.keyframes.bytes_per_member:.0f} B"
    recorded[name] = (s, measured.keyframes_curve)
    plots = [Plot("PSNR to the recorded trajectory, dB", recorded, "slider", span=_SPAN)]
    if len(measured.asked) > 1:
        edited = {_label(name): (curve.s, curve.psnr) for name, curve in measured.editor.items()}
        plots.append(Plot("PSNR to the editor's own pictures, dB", edited, "slider", span=_SPAN))
    return plots


def _uniformity_plots(measured: Measured, losses: Losses) -> list[Plot]:
    slider = measured.slider
    plots = [
        Plot(
            "visible change from the original",
            {"change": (even(len(slider.distances)), slider.distances)},
            "slider",
            span=_SPAN,
        ),
        Plot(
            f"visible change of each 1/{len(slider.steps)} of the slider",
            {"change": (middles(len(slider.steps)), slider.steps)},
            f"slider; smallest over largest {slider.uniformity:.2f}",
            low=0.0,
            span=_SPAN,
        ),
        _training(losses, measured.perceptual),
    ]
    return [*plots, _clip(measured.clip)] if measured.clip.s else plots


def _training(losses: Losses, perceptual: str) -> Plot:
    """Plot every loss term, as weighted, over the steps in which it was part of the loss."""
    names = {**_TERMS, "perceptual": "LPIPS" if perceptual.startswith("lpips") else "gradient L1"}
    lines: dict[str, Points] = {}
    for term, column in losses.items():
        rows = zip(losses["step"], column, strict=True)
        points = [(step, value) for step, value in rows if step is not None and value is not None]
        if term != "step":
            lines[names.get(term, term)] = ([step for step, _ in points], [value for _, value in points])
    return Plot("loss terms as weighted", lines, "steps", "log")


def _clip(direction: Direction) -> Plot:
    defined = [(s, v) for s, v in zip(direction.s, direction.similarity, strict=True) if v is not None]
    line = ([s for s, _ in defined], [v for _, v in defined])
    return Plot("CLIP directional similarity", {"slider": line}, "slider", low=0.0, span=_SPAN)


def column_heading(s: float, strength: float | None) -> str:
    """Return the heading of a column, with the editor's strength if it differs from the slider value."""
    suffix = "" if strength is None or abs(strength - s) < 5e-3 else f", editor {strength:.2g}"
    return f"s = {round(s, 2):g}{suffix}"


def _label(name: str) -> str:
    return name.replace("keyframes", "") + " keyframes" if name.startswith("keyframes") else name


def even(count: int) -> list[float]:
    """Return `count` evenly spaced slider values from 0 to 1."""
    return [i / max(1, count - 1) for i in range(count)]


def middles(count: int) -> list[float]:
    """Return the centers of `count` equal slider steps."""
    return [(i + 0.5) / count for i in range(count)]


def stack_plots(sheet: Image.Image, rows: Sequence[Sequence[Plot]]) -> Tensor:
    """Draw rows of plots below a sheet. -> [H,W,3]"""
    page = Image.new("RGB", (sheet.width, sheet.height + len(rows) * _PLOT_HEIGHT), PAPER)
    page.paste(sheet, (0, 0))
    for i, plots in enumerate(rows):
        width = sheet.width // len(plots)
        for j, plot in enumerate(plots):
            drawn = draw_plot(plot, width, _PLOT_HEIGHT)
            page.paste(drawn, (j * width, sheet.height + i * _PLOT_HEIGHT))
    return torch.from_numpy(np.asarray(page, dtype=np.float32) / 255.0)
