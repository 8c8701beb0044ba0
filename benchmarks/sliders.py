"""The benchmark `sliders`: the tables of a finished `progdf evaluate --suite sliders FOLDER`.

python -m benchmarks sliders --runs FOLDER
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from progdf.errors import ProgdfError
from trainer.evaluate.suite.results import edit_rows, read_results, summary_rows

from .table import Table


def tables(runs: Sequence[Path] = ()) -> list[Table]:
    """Read the results of one folder of the suite.

    Raises:
        ProgdfError: not one folder is named, or it holds no results.
    """
    if len(runs) != 1:
        raise ProgdfError("name one folder of progdf evaluate --suite sliders with --runs")
    results, suite = read_results(runs[0] / "sliders.json")
    note = (
        f"Version {suite['version']}, {suite['views']} views of {suite['image_size']} pixels, "
        f"{suite['steps']} steps, seed {suite['seed']}, {suite['threads'] or 'all'} thread(s)."
    )
    return [
        Table.of(
            "sliders",
            "Methods on edits with known truth, means over strengths 0.1 to 0.9, with 95 % intervals",
            summary_rows(results, suite["perceptual"]),
            note,
        ),
        Table.of(
            "sliders by edit",
            "PSNR at strengths 0.1 to 0.9 / at 1, by edit",
            edit_rows(results),
            note,
        ),
    ]
