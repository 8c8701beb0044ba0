"""All measures of `progdf evaluate`; docs/benchmarks.md explains each line."""

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
from trainer.report.measures import ErrorCurve, clip_curve, error_curves

from .consistency import EDITOR, UNEDITED, Consistency, clip_consistency, outside_change, view_consistency
from .opened import FADE, KEYFRAMES, SLIDER, OpenedRun


@dataclass(frozen=True)
class MeasureRow:
    """One line of the table."""

    name: str  # name in evaluation.json
    text: str  # label in the table, with the unit
    cells: Mapping[str, float | None]  # figures by column, None if undefined
    digits: int = 3  # decimal places
    missing: str = ""  # reason if not measured, else ""


@dataclass(frozen=True)
class Evaluation:
    """Result of an evaluation."""

    rows: tuple[MeasureRow, ...]  # the table
    # errors against the editor's pictures at their slider values, by contender
    curves: Mapping[str, ErrorCurve]
    paths: Mapping[str, SliderPath]  # the slider in equal steps, by contender
    consistency: Consistency  # between held-out views
    perceptual: str  # name of the perceptual distance


def evaluate_run(opened: OpenedRun, perceptual: Perceptual, texts: TextOptions) -> Evaluation:
    """Measure a finished run on its held-out views.

    Args:
        opened: see `open_run`
        perceptual: LPIPS or its substitute
        texts: texts for CLIP
    """
    evaluator = opened.evaluator
    contenders = opened.contenders()
    truth = {s: evaluator.edited[strength] for s, strength in opened.trajectory.stage_strengths}
    curves = error_curves(evaluator, contenders, tuple(truth), truth.__getitem__, perceptual)
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
        MeasureRow("evenness", "20 equal steps: evenness, smallest over largest change", of("evenness"), 2),
        MeasureRow("monotone", "steps that lead away from the original, share", of("monotone"), 2),
        MeasureRow("neighbors_mean", f"{lpips} of neighbors, mean", of("mean"), 4),
        MeasureRow("neighbors_largest", f"{lpips} of neighbors, largest", of("largest"), 4),
        MeasureRow("sum_over_ends", f"Σ {lpips} of neighbors / {lpips} of the ends", of("sum_over_ends")),
        MeasureRow("triangle_excess", "the same of their roots (1: straight)", of("triangle_excess"), 2),
    ]


def _consistency_rows(consistency: Consistency, lpips: str) -> list[MeasureRow]:
    missing = "" if consistency.pairs else "no other view shares enough pixels with a held-out view"
    return [
        MeasureRow(
            "warped_lpips", f"one view warped onto another, {lpips}", dict(consistency.lpips), 3, missing
        ),
        MeasureRow(
            "warped_psnr", "one view warped onto another, PSNR, dB", dict(consistency.psnr), 1, missing
        ),
    ]


def _clip_rows(opened: OpenedRun, texts: TextOptions) -> list[MeasureRow]:
    clip_direction = clip_curve(opened.evaluator, opened.setup.judging, opened.gdf.field, texts)
    along, missing = clip_consistency(opened)
    direction = clip_direction.similarity[-1] if clip_direction.similarity else None
    return [
        MeasureRow(
            "clip_direction", "CLIP direction similarity at 1", {SLIDER: direction}, 3, clip_direction.reason
        ),
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
        MeasureRow("seconds", "run, s", {SLIDER: seconds}, 0, "" if seconds else "missing in report.json"),
        MeasureRow(
            "memory_mb", "peak memory, MB", {SLIDER: memory}, 0, "" if memory else "missing in report.json"
        ),
    ]


@dataclass(frozen=True)
class SliderPath:
    """Measures of a slider in 20 equal steps."""

    # smallest over largest visible change of a step, like `uniformity` in report.json, 0 to 1
    evenness: float
    monotone: float  # share of the steps that move away from the original, by visible change, 0 to 1
    steps: tuple[float, ...]  # LPIPS between neighboring slider values. [20]
    from_original: tuple[float, ...]  # LPIPS from slider value 0, at the 21 values

    @property
    def ends(self) -> float:
        """LPIPS between slider values 0 and 1."""
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
        """Sum of the neighbors' LPIPS over the LPIPS of the ends.

        It is 1/20 for a straight path in equal steps, as LPIPS is a squared distance.
        """
        return sum(self.steps) / self.ends if self.ends > 0 else math.nan

    @property
    def triangle_excess(self) -> float:
        """Like `sum_over_ends`, of square roots, which are distances: 1 on a straight path, else more."""
        return sum(math.sqrt(d) for d in self.steps) / math.sqrt(self.ends) if self.ends > 0 else math.nan


def slider_path(evaluator: Evaluator, pictures: Pictures, perceptual: Perceptual) -> SliderPath:
    """Measure a slider in `STEPS` equal steps. `pictures`: slider value -> the held-out views' boxes"""
    pictures_by_s = {i / STEPS: pictures(i / STEPS) for i in range(STEPS + 1)}
    statistics = slider_statistics(
        lambda s: pictures_by_s[s] if s in pictures_by_s else pictures(s), STEPS, masks=evaluator.pixels
    )
    steps = [evaluator.perceptual(b, a, perceptual) for a, b in pairwise(pictures_by_s.values())]
    from_original = [
        evaluator.perceptual(current, pictures_by_s[0.0], perceptual, "original")
        for current in pictures_by_s.values()
    ]
    perceptual.forget()
    rises = [b > a for a, b in pairwise(statistics.distances)]
    return SliderPath(statistics.uniformity, sum(rises) / len(rises), tuple(steps), tuple(from_original))


COLUMNS = (SLIDER, KEYFRAMES, FADE, EDITOR, UNEDITED)


def evaluation_table(evaluation: Evaluation) -> str:
    """Return the whole table, with the reasons for missing measures below it."""
    rows = [(row.text, *(_cell(row, column) for column in COLUMNS)) for row in evaluation.rows]
    notes = [f"{row.text}: not measured, {row.missing}" for row in evaluation.rows if row.missing]
    return "\n".join([markdown_table(("", *COLUMNS), rows), *(["", *notes] if notes else [])])


SUMMARY = ("psnr_end", "psnr_between", "lpips_end", "evenness", "bytes_per_member", "seconds")
"""Rows that are columns in the table of a batch."""


def summary_table(names: Sequence[str], evaluations: Sequence[Evaluation]) -> str:
    """Return a table with one line per run: its slider's figures of `SUMMARY`."""
    lines = []
    for name, evaluation in zip(names, evaluations, strict=True):
        rows = {row.name: row for row in evaluation.rows}
        lines.append((name, *(_cell(rows[key], SLIDER) if key in rows else "" for key in SUMMARY)))
    return markdown_table(("", *(key.replace("_", " ") for key in SUMMARY)), lines)


def evaluation_json(evaluation: Evaluation) -> dict[str, Any]:
    """Return evaluation.json: rows by name, with their figures by column or the reason if missing."""
    rows = {row.name: {"missing": row.missing} if row.missing else _round_row(row) for row in evaluation.rows}
    curves = {name: curve.to_json() for name, curve in evaluation.curves.items()}
    pairs = [
        {"source": pair.source, "target": pair.target, "shared": round(pair.shared, 3)}
        for pair in evaluation.consistency.pairs
    ]
    return {"perceptual": evaluation.perceptual, "rows": rows, "pairs": pairs, "against_editor": curves}


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format rows of cells as a GitHub Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _cell(row: MeasureRow, column: str) -> str:
    value = row.cells.get(column)
    return "" if value is None else f"{value:.{row.digits}f}"


def _round_row(row: MeasureRow) -> dict[str, float | None]:
    digits = row.digits + 2
    return {name: None if value is None else round(value, digits) for name, value in row.cells.items()}
