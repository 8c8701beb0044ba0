"""The figures as a table in Markdown and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from .consistency import EDITOR, UNEDITED
from .measures import Evaluation, Row
from .opened import FADE, KEYFRAMES, SLIDER

COLUMNS = (SLIDER, KEYFRAMES, FADE, EDITOR, UNEDITED)


def evaluation_table(evaluation: Evaluation) -> str:
    """The whole table; what could not be measured says why below it."""
    rows = [(row.text, *(_cell(row, column) for column in COLUMNS)) for row in evaluation.rows]
    notes = [f"{row.text}: not measured, {row.missing}" for row in evaluation.rows if row.missing]
    return "\n".join([markdown_table(("", *COLUMNS), rows), *(["", *notes] if notes else [])])


def evaluation_json(evaluation: Evaluation) -> dict[str, Any]:
    """As evaluation.json has it: rows by name, their figures by column, or why there are none."""
    rows = {row.name: {"missing": row.missing} if row.missing else _rounded(row) for row in evaluation.rows}
    curves = {
        name: {"s": curve.s, "psnr": curve.psnr, "ssim": curve.ssim, "lpips": curve.lpips}
        for name, curve in evaluation.curves.items()
    }
    pairs = [
        {"source": pair.source, "target": pair.target, "shared": round(pair.shared, 3)}
        for pair in evaluation.consistency.pairs
    ]
    return {"perceptual": evaluation.perceptual, "rows": rows, "pairs": pairs, "against_editor": curves}


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as GitHub Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _cell(row: Row, column: str) -> str:
    value = row.cells.get(column)
    return "" if value is None else f"{value:.{row.digits}f}"


def _rounded(row: Row) -> dict[str, float | None]:
    digits = row.digits + 2
    return {name: None if value is None else round(value, digits) for name, value in row.cells.items()}
