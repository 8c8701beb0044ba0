"""Everything that `progdf evaluate` tells of a run; what each line means is in docs/benchmarks.md."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from progdf.metrics.slider import Pictures, slider_statistics
from trainer.fit.evaluate import Evaluator
from trainer.fit.slider_uniformity import STEPS
from trainer.optimize.losses import Perceptual
from trainer.options import TextOptions
from trainer.report.measures import ErrorCurve, clip_curve, picture_courses

from .consistency import EDITOR, UNEDITED, Consistency, clip_consistency, outside_change, view_consistency
from .opened import FADE, KEYFRAMES, SLIDER, OpenedRun


@dataclass(frozen=True)
class MeasureRow:
    """One line of the table."""

    name: str  # in evaluation.json
    text: str  # in the table, with the unit
    cells: Mapping[str, float | None]  # by column: figures, None where one is not defined
    digits: int = 3  # behind the point
    missing: str = ""  # why nothing was measured, "" where it was


@dataclass(frozen=True)
class Evaluation:
    """What was measured."""

    rows: tuple[MeasureRow, ...]  # the table
    # against the editor's own pictures at the slider values that it was asked for, by what is shown
    curves: Mapping[str, ErrorCurve]
    paths: Mapping[str, SliderPath]  # the slider in equal steps, by what is shown
    consistency: Consistency  # between held-out views
    perceptual: str  # name of the perceptual distance


def evaluate_run(opened: OpenedRun, perceptual: Perceptual, texts: TextOptions) -> Evaluation:
    """Measure a finished run on its held-out views.

    Args:
        opened: see `open_run`
        perceptual: LPIPS, or its stand-in
        texts: what CLIP is asked
    """
    evaluator = opened.evaluator
    contenders = opened.contenders()
    truth = {s: evaluator.edited[strength] for s, strength in opened.trajectory.stage_strengths}
    curves = picture_courses(evaluator, contenders, tuple(truth), truth.__getitem__, perceptual)
    paths = {name: slider_path(evaluator, pictures, perceptual) for name, pictures in contenders.items()}
    consistency = view_consistency(opened, perceptual)
    lpips = "LPIPS" if perceptual.name.startswith("lpips") else perceptual.name
    outside: dict[str, float | None] = {whose: 255 * x for whose, x in outside_change(opened).items()}
    views = (
        "to the run's own pictures, trained on,",
        "to the one edited view held out,",
        "to the edited views",
    )
    rows = (
        *_edited_rows(curves, lpips, views[min(len(opened.setup.held_out), 2)]),
        *_path_rows(paths, lpips),
        *_consistency_rows(consistency, lpips),
        MeasureRow("outside", "outside the region, mean change, of 255", outside),
        *_clip_rows(opened, texts),
        *_cost_rows(opened),
    )
    return Evaluation(rows, curves, paths, consistency, perceptual.name)


def _edited_rows(curves: Mapping[str, ErrorCurve], lpips: str, views: str) -> list[MeasureRow]:
    def cells(measure: str, part: slice) -> dict[str, float | None]:
        values = {name: getattr(curve, measure)[part] for name, curve in curves.items()}
        return {name: sum(some) / len(some) for name, some in values.items()}

    measures = (("psnr", "PSNR, dB", 1), ("ssim", "SSIM", 4), ("lpips", lpips, 4))
    inner = len(next(iter(curves.values())).s) - 1
    rows = [
        MeasureRow(f"{name}_end", f"{views} at 1, {text}", cells(name, slice(-1, None)), digits)
        for name, text, digits in measures
    ]
    if not inner:
        return rows
    places = "value" if inner == 1 else "values"
    lowest: dict[str, float | None] = {name: min(curve.psnr) for name, curve in curves.items()}
    return [
        *rows,
        *(
            MeasureRow(
                f"{name}_between", f"at {inner} {places} between, {text}", cells(name, slice(-1)), digits
            )
            for name, text, digits in measures
        ),
        MeasureRow("psnr_worst", "the worst of all these, PSNR, dB", lowest, 1),
    ]


def _path_rows(paths: Mapping[str, SliderPath], lpips: str) -> list[MeasureRow]:
    def of(value: str) -> dict[str, float | None]:
        numbers = {name: float(getattr(path, value)) for name, path in paths.items()}
        return {name: None if math.isnan(number) else number for name, number in numbers.items()}

    return [
        MeasureRow("evenness", "20 equal steps: evenness, least over largest change", of("evenness"), 2),
        MeasureRow("monotone", "steps that lead away from the original, share", of("monotone"), 2),
        MeasureRow("neighbors_mean", f"{lpips} of neighbors, mean", of("mean"), 4),
        MeasureRow("neighbors_largest", f"{lpips} of neighbors, largest", of("largest"), 4),
        MeasureRow("sum_over_ends", f"Σ {lpips} of neighbors / {lpips} of the ends", of("sum_over_ends")),
        MeasureRow("triangle_excess", "the same of their roots (1: straight)", of("triangle_excess"), 2),
    ]


def _consistency_rows(consistency: Consistency, lpips: str) -> list[MeasureRow]:
    missing = "" if consistency.pairs else "no other view sees enough of what a held-out one does"
    return [
        MeasureRow(
            "warped_lpips", f"one view warped onto another, {lpips}", dict(consistency.lpips), 3, missing
        ),
        MeasureRow(
            "warped_psnr", "one view warped onto another, PSNR, dB", dict(consistency.psnr), 1, missing
        ),
    ]


def _clip_rows(opened: OpenedRun, texts: TextOptions) -> list[MeasureRow]:
    course = clip_curve(opened.evaluator, opened.setup.judging, opened.gdf.field, texts)
    along, missing = clip_consistency(opened)
    direction = course.similarity[-1] if course.similarity else None
    return [
        MeasureRow("clip_direction", "CLIP direction similarity at 1", {SLIDER: direction}, 3, course.reason),
        MeasureRow(
            "clip_consistency", "CLIP direction consistency along a path", {SLIDER: along}, 3, missing
        ),
    ]


def _cost_rows(opened: OpenedRun) -> list[MeasureRow]:
    gdf = opened.gdf
    memory = opened.figures.memory_mb
    seconds = opened.figures.time.total
    sizes: dict[str, float | None] = {
        SLIDER: gdf.field.bytes_per_member,
        KEYFRAMES: opened.keyframes.bytes_per_member,
    }
    return [
        MeasureRow("bytes_per_member", f"bytes for each of {len(gdf.region)} members", sizes, 0),
        MeasureRow("seconds", "run, s", {SLIDER: seconds}, 0, "" if seconds else "report.json does not say"),
        MeasureRow(
            "memory_mb", "peak memory, MB", {SLIDER: memory}, 0, "" if memory else "report.json does not say"
        ),
    ]


@dataclass(frozen=True)
class SliderPath:
    """A slider in 20 equal steps."""

    evenness: float  # smallest over largest visible change of a step, as report.json's `uniformity`, 0..1
    monotone: float  # share of the steps that lead away from the original, by visible change, 0..1
    steps: tuple[float, ...]  # LPIPS between neighboring slider values. [20]
    from_original: tuple[float, ...]  # LPIPS from slider value 0, at the 21 values

    @property
    def ends(self) -> float:
        """LPIPS between both ends."""
        return self.from_original[-1]

    @property
    def mean(self) -> float:
        """Mean LPIPS of neighbors."""
        return sum(self.steps) / len(self.steps)

    @property
    def largest(self) -> float:
        """Largest LPIPS of neighbors."""
        return max(self.steps)

    @property
    def sum_over_ends(self) -> float:
        """Σ LPIPS of neighbors over LPIPS of the ends; 1/20 for a straight way in equal steps, as LPIPS is a
        squared distance."""
        return sum(self.steps) / self.ends if self.ends > 0 else math.nan

    @property
    def triangle_excess(self) -> float:
        """The same of the roots, which are distances: at least 1, and 1 for a straight way."""
        return sum(math.sqrt(d) for d in self.steps) / math.sqrt(self.ends) if self.ends > 0 else math.nan


def slider_path(evaluator: Evaluator, pictures: Pictures, perceptual: Perceptual) -> SliderPath:
    """Walk a slider. `pictures`: slider value -> the held-out views' boxes"""
    shown = {i / STEPS: pictures(i / STEPS) for i in range(STEPS + 1)}
    statistics = slider_statistics(
        lambda s: shown[s] if s in shown else pictures(s), STEPS, masks=evaluator.pixels
    )
    steps = [evaluator.perceptual(b, a, perceptual) for a, b in pairwise(shown.values())]
    from_original = [evaluator.perceptual(now, shown[0.0], perceptual, "original") for now in shown.values()]
    perceptual.forget()
    rises = [b > a for a, b in pairwise(statistics.distances)]
    return SliderPath(statistics.uniformity, sum(rises) / len(rises), tuple(steps), tuple(from_original))


COLUMNS = (SLIDER, KEYFRAMES, FADE, EDITOR, UNEDITED)


def evaluation_table(evaluation: Evaluation) -> str:
    """The whole table; what could not be measured says why below it."""
    rows = [(row.text, *(_cell(row, column) for column in COLUMNS)) for row in evaluation.rows]
    notes = [f"{row.text}: not measured, {row.missing}" for row in evaluation.rows if row.missing]
    return "\n".join([markdown_table(("", *COLUMNS), rows), *(["", *notes] if notes else [])])


SUMMARY = ("psnr_end", "psnr_between", "lpips_end", "evenness", "bytes_per_member", "seconds")
"""Rows of which the table of a batch has a column."""


def summary_table(names: Sequence[str], evaluations: Sequence[Evaluation]) -> str:
    """A line a run: what its slider reaches in `SUMMARY`."""
    lines = []
    for name, evaluation in zip(names, evaluations, strict=True):
        rows = {row.name: row for row in evaluation.rows}
        lines.append((name, *(_cell(rows[key], SLIDER) if key in rows else "" for key in SUMMARY)))
    return markdown_table(("", *(key.replace("_", " ") for key in SUMMARY)), lines)


def evaluation_json(evaluation: Evaluation) -> dict[str, Any]:
    """As evaluation.json has it: rows by name, their figures by column, or why there are none."""
    rows = {row.name: {"missing": row.missing} if row.missing else _round_row(row) for row in evaluation.rows}
    curves = {name: curve.to_json() for name, curve in evaluation.curves.items()}
    pairs = [
        {"source": pair.source, "target": pair.target, "shared": round(pair.shared, 3)}
        for pair in evaluation.consistency.pairs
    ]
    return {"perceptual": evaluation.perceptual, "rows": rows, "pairs": pairs, "against_editor": curves}


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as GitHub Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _cell(row: MeasureRow, column: str) -> str:
    value = row.cells.get(column)
    return "" if value is None else f"{value:.{row.digits}f}"


def _round_row(row: MeasureRow) -> dict[str, float | None]:
    digits = row.digits + 2
    return {name: None if value is None else round(value, digits) for name, value in row.cells.items()}
