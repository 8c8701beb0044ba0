"""What the suite `sliders` found: table, JSON and picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from progdf.io.images import contact_sheet, to_picture
from trainer.report.curves import ErrorCurve
from trainer.report.plots import Plot
from trainer.report.report import stack_plots, thumbnail

from .opened import FADE, KEYFRAMES, SLIDER
from .suite import STRENGTHS, CaseResult
from .table import markdown_table

_SHOWN = (SLIDER, KEYFRAMES, FADE)
_THUMBNAIL = 170
_PLOTS_A_ROW = 5


def suite_rows(results: Sequence[CaseResult]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Headings, and a row an edit: mean and worst PSNR over strengths .1 to 1, mean LPIPS over the same."""
    head = (
        "edit",
        "members",
        *(f"{name}, PSNR mean / worst, dB" for name in _SHOWN),
        *(f"{name}, LPIPS" for name in _SHOWN),
        "PSNR at 1, dB",
        "bytes a member",
    )
    rows = [
        (
            result.case.name,
            str(result.members),
            *(_decibels(result.curves[name]) for name in _SHOWN),
            *(f"{_mean(result.curves[name].lpips[1:]):.4f}" for name in _SHOWN),
            f"{result.curves[SLIDER].psnr[-1]:.1f}",
            f"{result.bytes_per_member:.0f}",
        )
        for result in results
    ]
    return head, rows


def suite_table(results: Sequence[CaseResult]) -> str:
    """The same in Markdown."""
    return markdown_table(*suite_rows(results))


def suite_json(results: Sequence[CaseResult], perceptual: str) -> dict[str, Any]:
    """As sliders.json has it."""
    edits = {
        result.case.name: {
            "scene": result.case.scene,
            "editor": result.case.editor or "analytic",
            "members": result.members,
            "bytes_per_member": round(result.bytes_per_member, 1),
            "seconds": result.seconds,
            "curves": {
                name: {"psnr": curve.psnr, "ssim": curve.ssim, "lpips": curve.lpips}
                for name, curve in result.curves.items()
            },
        }
        for result in results
    }
    return {"perceptual": perceptual, "strengths": STRENGTHS, "edits": edits}


def suite_picture(results: Sequence[CaseResult]) -> Tensor:
    """A row an edit, half way and at the end; then PSNR over the slider. -> [H,W,3]"""
    names = ("truth", *_SHOWN)
    rows = [
        [thumbnail(_square(result.strips[name][end]), _THUMBNAIL) for end in (0, 1) for name in names]
        for result in results
    ]
    heads = [f"{name}, {s}" for s in (".5", "1") for name in names]
    sheet = contact_sheet(rows, [result.case.name for result in results], heads, "Sliders against the truth")
    plots = [
        Plot(
            f"{result.case.name}: PSNR, dB",
            {name: (STRENGTHS[1:], result.curves[name].psnr[1:]) for name in _SHOWN},
            "slider",
            span=(0.0, 1.0),
        )
        for result in results
    ]
    lines = [plots[i : i + _PLOTS_A_ROW] for i in range(0, len(plots), _PLOTS_A_ROW)]
    return stack_plots(to_picture(sheet), lines)


def _decibels(curve: ErrorCurve) -> str:
    return f"{_mean(curve.psnr[1:]):.1f} / {min(curve.psnr[1:]):.1f}"


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _square(image: Tensor) -> Tensor:
    """On white, as wide as high, so that all thumbnails are of one size. [h,w,3] -> [n,n,3]"""
    height, width = image.shape[:2]
    side = max(height, width)
    page = image.new_ones(side, side, 3)
    top, left = (side - height) // 2, (side - width) // 2
    page[top : top + height, left : left + width] = image
    return page
