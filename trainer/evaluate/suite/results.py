"""Results of the suite `sliders`: errors by edit and view, confidence intervals, table, JSON and picture."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

import progdf
from progdf.errors import ProgdfError
from progdf.io.images import contact_sheet, to_picture
from progdf.io.json_values import convert_json, decode_json
from trainer.evaluate.measures import markdown_table
from trainer.report.plots import Plot
from trainer.report.report import stack_plots, thumbnail

from .edits import GIVEN, STRENGTHS, KnownEdit, Suite

FADE = "cross-fade"
"""Reference in picture space: a cross-fade in sRGB between the true pictures of both ends."""

SHOWN_STRENGTHS = (0.5, 1.0)
"""Strengths of the thumbnails."""

MEASURES = ("psnr", "ssim", "lpips")

_RESAMPLES = 10_000  # bootstrap resamples of edits and views
_BOOTSTRAP_SEED = 0
_PERCENTILES = (2.5, 97.5)  # limits of a 95 % interval
_DIGITS = {"psnr": 3, "ssim": 5, "lpips": 5}  # decimal places in the JSON file
_THUMBNAIL_WIDTH = 170  # pixels
_PLOTS_PER_ROW = 5

Errors = NDArray[np.float64]
"""Errors of one measure. [V,S], views and `STRENGTHS`"""


@dataclass(frozen=True)
class EditResult:
    """Errors of all methods on one edit."""

    edit: KnownEdit  # the edit
    gaussians: int  # number of Gaussians of its scene
    members: int  # number of Gaussians of its region
    views: tuple[str, ...]  # names of the held-out views
    errors: Mapping[str, Mapping[str, Errors]]  # method → measure → errors
    seconds: Mapping[str, float]  # processor time of each method
    # the largest held-out view at `SHOWN_STRENGTHS`, of the truth and each method. [h,w,3] each
    strips: Mapping[str, Sequence[Tensor]]


@dataclass(frozen=True)
class Estimate:
    """Mean with a 95 % confidence interval."""

    mean: float
    low: float
    high: float

    def text(self, digits: int) -> str:
        """Format as `mean [low, high]`."""
        return f"{self.mean:.{digits}f} [{self.low:.{digits}f}, {self.high:.{digits}f}]"

    def to_json(self) -> dict[str, float]:
        """Return the rounded values."""
        return {name: round(value, 5) for name, value in vars(self).items()}


def bootstrap(values: Sequence[NDArray[np.float64]]) -> Estimate:
    """Return the mean over edits of the means over views, with a 95 % interval.

    The interval holds the 2.5th to 97.5th percentile of this mean over 10 000 resamples. Each draws as many
    edits as there are, with replacement, and for each drawn edit as many of its views as there are, with
    replacement. The draws have a fixed seed, so that differences of methods are paired.

    Args:
        values: a value per view, for each edit. [V] each
    """
    random = np.random.default_rng(_BOOTSTRAP_SEED)
    edits = random.integers(len(values), size=(_RESAMPLES, len(values)))
    means = np.zeros(_RESAMPLES)
    for column in range(len(values)):
        picks = random.random((_RESAMPLES, max(len(of_edit) for of_edit in values)))
        for index, of_edit in enumerate(values):
            rows = np.flatnonzero(edits[:, column] == index)
            chosen = (picks[rows, : len(of_edit)] * len(of_edit)).astype(np.int64)
            means[rows] += of_edit[chosen].mean(axis=1)
    low, high = np.percentile(means / len(values), _PERCENTILES)
    mean = float(np.mean([of_edit.mean() for of_edit in values]))
    return Estimate(mean, float(low), float(high))


def method_names(results: Sequence[EditResult]) -> list[str]:
    """Return the names of the methods in order, the reference last."""
    return list(results[0].errors)


def _between(results: Sequence[EditResult], method: str, measure: str) -> list[NDArray[np.float64]]:
    """Return the means over strengths 0.1 to 0.9, by edit and view. [V] each"""
    return [result.errors[method][measure][:, 1:-1].mean(axis=1) for result in results]


def _at_end(results: Sequence[EditResult], method: str, measure: str) -> list[NDArray[np.float64]]:
    """Return the values at strength 1, by edit and view. [V] each"""
    return [result.errors[method][measure][:, -1] for result in results]


def summarize(results: Sequence[EditResult]) -> dict[str, dict[str, Estimate]]:
    """Return the estimates of every method: `PSNR_between`, `psnr_end`, …, and the difference to the first
    method, `psnr_gain`."""
    names = method_names(results)
    summary = {}
    for name in names:
        estimates = {f"{m}_between": bootstrap(_between(results, name, m)) for m in MEASURES}
        estimates |= {f"{m}_end": bootstrap(_at_end(results, name, m)) for m in MEASURES}
        pairs = zip(_between(results, name, "psnr"), _between(results, names[0], "psnr"), strict=True)
        estimates["psnr_gain"] = bootstrap([ours - first for ours, first in pairs])
        summary[name] = estimates
    return summary


def summary_rows(results: Sequence[EditResult], perceptual: str) -> list[dict[str, str]]:
    """Return a row per method, with 95 % intervals: heading → cell."""
    first = method_names(results)[0]
    label = "LPIPS" if perceptual.startswith("lpips") else perceptual
    rows = []
    for name, of in summarize(results).items():
        worst = min(float(result.errors[name]["psnr"][:, 1:-1].min()) for result in results)
        seconds = float(np.mean([result.seconds[name] for result in results]))
        rows.append(
            {
                "method": name,
                "PSNR, dB": of["psnr_between"].text(1),
                f"against {first}, dB": "" if name == first else of["psnr_gain"].text(1),
                "worst, dB": f"{worst:.1f}",
                "SSIM": of["ssim_between"].text(3),
                label: of["lpips_between"].text(4),
                "PSNR at 1, dB": "exact" if name == FADE else of["psnr_end"].text(1),
                "processor s per edit": "" if name == FADE else f"{seconds:.1f}",
            }
        )
    return rows


def edit_rows(results: Sequence[EditResult]) -> list[dict[str, str]]:
    """Return a row per edit, with each method's PSNR between the ends and at 1: heading → cell."""
    rows = []
    for result in results:
        row = {"edit": result.edit.name, "scene": result.edit.scene, "members": str(result.members)}
        for name in method_names(results):
            between = _between([result], name, "psnr")[0].mean()
            end = _at_end([result], name, "psnr")[0].mean()
            row[f"{name}, dB"] = f"{between:.1f}" if name == FADE else f"{between:.1f} / {end:.1f}"
        rows.append(row)
    return rows


def format_rows(rows: Sequence[Mapping[str, str]]) -> str:
    """Format rows of the same headings as Markdown."""
    return markdown_table(tuple(rows[0]), [tuple(row.values()) for row in rows])


def suite_json(
    results: Sequence[EditResult], perceptual: str, suite: Suite, seed: int, threads: int
) -> dict[str, Any]:
    """Return the content of sliders.json.

    Args:
        results: the results by edit
        perceptual: name of the perceptual distance
        suite: version of the suite
        seed, threads: see `EvaluateOptions`
    """
    edits = {
        result.edit.name: {
            "scene": result.edit.scene,
            "truth": result.edit.editor or "formula",
            "gaussians": result.gaussians,
            "members": result.members,
            "views": list(result.views),
            "methods": {
                name: {
                    **{measure: _round_errors(errors[measure], measure) for measure in MEASURES},
                    "seconds": round(result.seconds[name], 2),
                }
                for name, errors in result.errors.items()
            },
        }
        for result in results
    }
    summary = {
        name: {measure: estimate.to_json() for measure, estimate in estimates.items()}
        for name, estimates in summarize(results).items()
    }
    return {
        "suite": "sliders",
        "version": suite.version,
        "seed": seed,
        "threads": threads,
        **asdict(suite.effort),
        "perceptual": perceptual,
        "given": list(GIVEN),
        "strengths": list(STRENGTHS),
        "software": _software(),
        "summary": summary,
        "edits": edits,
    }


def read_results(path: Path) -> tuple[list[EditResult], dict[str, Any]]:
    """Read a sliders.json. Return its results, without pictures, and its other entries.

    Raises:
        ProgdfError: the file is missing or damaged.
    """
    try:
        content = convert_json(decode_json(path.read_bytes()), dict[str, Any])
        edits = content.pop("edits")
    except FileNotFoundError:
        raise ProgdfError(f"{path} does not exist; run progdf evaluate --suite sliders first") from None
    except (ValueError, KeyError) as error:
        raise ProgdfError(f"{path} is damaged ({error}); run progdf evaluate --suite sliders again") from None
    results = []
    for name, of in edits.items():
        errors = {
            method: {measure: np.array(values[measure]) for measure in MEASURES}
            for method, values in of["methods"].items()
        }
        seconds = {method: float(values["seconds"]) for method, values in of["methods"].items()}
        edit = KnownEdit(name, of["scene"], (), "" if of["truth"] == "formula" else of["truth"])
        views = tuple(of["views"])
        results.append(EditResult(edit, of["gaussians"], of["members"], views, errors, seconds, {}))
    return results, content


def _round_errors(errors: Errors, measure: str) -> list[list[float]]:
    digits = _DIGITS[measure]
    return [[round(float(value), digits) for value in row] for row in errors]


def _software() -> dict[str, str]:
    """Return the versions on which the last digits depend."""
    return {
        "progdf": progdf.__version__,
        "interpreter": platform.python_version(),
        **{name: version(name) for name in ("torch", "numba", "numpy")},
        "system": platform.platform(terse=True),
        "machine": platform.machine(),
        "cores": str(os.cpu_count()),
    }


def suite_picture(results: Sequence[EditResult]) -> Tensor:
    """Draw each edit at strengths 0.5 and 1, and PSNR over the slider below. -> [H,W,3]"""
    names = ("truth", *method_names(results))
    rows = [
        [
            thumbnail(_square(result.strips[name][i]), _THUMBNAIL_WIDTH)
            for i in range(len(SHOWN_STRENGTHS))
            for name in names
        ]
        for result in results
    ]
    heads = [f"{name}, {s:g}" for s in SHOWN_STRENGTHS for name in names]
    labels = [result.edit.name for result in results]
    sheet = contact_sheet(rows, labels, heads, "Sliders against the truth")
    inner = slice(1, -1)
    plots = [
        Plot(
            f"{result.edit.name}: PSNR, dB",
            {
                name: (STRENGTHS[inner], tuple(errors["psnr"].mean(axis=0)[inner].tolist()))
                for name, errors in result.errors.items()
            },
            "slider",
            span=(0.0, 1.0),
        )
        for result in results
    ]
    lines = [plots[i : i + _PLOTS_PER_ROW] for i in range(0, len(plots), _PLOTS_PER_ROW)]
    return stack_plots(to_picture(sheet), lines)


def _square(image: Tensor) -> Tensor:
    """Center an image on a white square, so that all thumbnails have one size. [h,w,3] -> [n,n,3]"""
    height, width = image.shape[:2]
    side = max(height, width)
    page = image.new_ones(side, side, 3)
    top = (side - height) // 2
    left = (side - width) // 2
    page[top : top + height, left : left + width] = image
    return page
