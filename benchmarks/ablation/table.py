"""What an ablation found: as a table on the terminal and in Markdown, and as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table as RichTable
from torch import Tensor

from benchmarks.table import Table, machine
from progdf.io.images import contact_sheet
from trainer.report.report import SHOWN, Columns, column_heading

BETWEEN = SHOWN[1:-1]


@dataclass(frozen=True)
class Outcome:
    """What became of one variant, on held-out views.

    Args:
        name, what: of the variant
        psnr, ssim, lpips: of the finished edit to the edited views
        between: a quarter, half or three quarters of the slider → PSNR to the editor's own picture from
            there or near by, dB, where it was asked
        uniformity: least over largest visible change of twenty equal steps, 0..1
        t50, t90: slider value at which half and nine tenths of the change are reached
        bytes_per_member: of the field
        seconds: of the optimization
        objective: the loss, in words
        failed: why there are no figures, "" where there are
    """

    name: str
    what: str
    psnr: float = 0.0
    ssim: float = 0.0
    lpips: float = 0.0
    between: Mapping[str, float] | None = None
    uniformity: float = 0.0
    t50: float = 0.0
    t90: float = 0.0
    bytes_per_member: float = 0.0
    seconds: float = 0.0
    objective: str = ""
    failed: str = ""


def table_of(outcomes: Sequence[Outcome], title: str, perceptual: str, note: str = "") -> Table:
    """The outcomes as a table. `perceptual`: LPIPS, or what stands in for it."""
    columns = ("variant", "what", "PSNR, dB", perceptual, *(f"at {s:g}, dB" for s in BETWEEN))
    columns += ("uniform", "t50", "t90", "bytes", "train, s")
    notes = [
        "On held-out views, over the pixels that show the region: the finished edit against the edited "
        "views, the slider near these strengths against the editor's own picture (–: it was not asked); "
        "least over largest visible change of 20 equal steps; slider value at 50 and 90 % of the change; "
        "bytes per member.",
        note,
        *(f"{outcome.name}: {outcome.failed}." for outcome in outcomes if outcome.failed),
        f"{machine()}.",
    ]
    rows = tuple(_row(outcome) for outcome in outcomes)
    return Table("ablation", title, columns, rows, " ".join(text for text in notes if text))


def print_table(outcomes: Sequence[Outcome], title: str, perceptual: str) -> None:
    """The figures on the terminal, within 80 columns."""
    drawn = RichTable(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    columns = (
        "variant",
        "PSNR",
        perceptual,
        *(f"{s:g}"[1:] for s in BETWEEN),
        "even",
        "t50",
        "t90",
        "bytes",
        "s",
    )
    for i, column in enumerate(columns):
        drawn.add_column(column, justify="left" if i == 0 else "right", no_wrap=True)
    for outcome in outcomes:
        name, _, *figures = _row(outcome)
        drawn.add_row(name, *figures)
    console = Console(highlight=False)
    console.print(drawn)
    for outcome in outcomes:
        if outcome.failed:
            console.print(f"{outcome.name}: {outcome.failed}", soft_wrap=True)


def sheet_of(
    editor: Sequence[Tensor],
    outcomes: Sequence[Outcome],
    strips: Mapping[str, Sequence[Tensor]],
    columns: Columns,
    title: str,
    caption: str,
) -> Tensor:
    """The picture: a row per variant, the editor's own pictures on top.

    Args:
        editor: what the editor made of the pictured view, at five strengths. [h,w,3] each
        outcomes: variants in order
        strips: their pictures, by name, of the same size
        columns: where on the run's slider
        title, caption: a line above and below
    """
    shown = [outcome for outcome in outcomes if outcome.name in strips]
    return contact_sheet(
        [editor, *(strips[outcome.name] for outcome in shown)],
        ["the editor", *(f"{outcome.name}\n{outcome_line(outcome)}" for outcome in shown)],
        [column_heading(*column) for column in columns],
        title,
        caption,
    )


def _row(outcome: Outcome) -> tuple[str, ...]:
    if outcome.failed:
        return (outcome.name, outcome.what, *("–" for _ in range(2 + len(BETWEEN) + 5)))
    between = outcome.between or {}
    return (
        outcome.name,
        outcome.what,
        f"{outcome.psnr:.1f}",
        f"{outcome.lpips:.4f}",
        *(f"{between[f'{s:g}']:.1f}" if f"{s:g}" in between else "–" for s in BETWEEN),
        f"{outcome.uniformity:.2f}",
        f"{outcome.t50:.2f}",
        f"{outcome.t90:.2f}",
        f"{outcome.bytes_per_member:.0f}",
        f"{outcome.seconds:.1f}",
    )


def outcome_line(outcome: Outcome) -> str:
    """In short: the two figures that say most: how good the end is, how good the way."""
    between = list((outcome.between or {}).values())
    way = f", between {sum(between) / len(between):.1f}" if between else ""
    return f"end {outcome.psnr:.1f}{way} dB"
