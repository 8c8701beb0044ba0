"""Results of ablations: a table for the terminal and for Markdown, and a picture of each run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from rich.console import Console
from rich.table import Table as RichTable
from torch import Tensor

from benchmarks.table import Table, machine
from progdf.io.images import contact_sheet
from trainer.report.report import Columns, column_heading


@dataclass(frozen=True)
class Outcome:
    """Result of one variant with one seed, on held-out views."""

    # name, what, of: see `Variant`
    name: str
    what: str
    of: str = ""
    # psnr, ssim, lpips: finished edit against the edited views
    psnr: float = 0.0
    ssim: float = 0.0
    lpips: float = 0.0
    # slider value 0.25, 0.5 or 0.75 → PSNR against the editor's picture there or nearby, dB; values without
    # such a picture are absent
    between: Mapping[str, float] | None = None
    uniformity: float = 0.0  # smallest over largest visible change of twenty equal steps, 0 to 1
    # t50, t90: slider value at which half and nine tenths of the change are reached
    t50: float = 0.0
    t90: float = 0.0
    bytes_per_member: float = 0.0  # of the field
    # processor time of the optimization, including a jointly trained network
    seconds: float = 0.0
    objective: str = ""  # the loss in words, without terms that the variant replaces or adds
    failed: str = ""  # reason if there are no figures, else ""

    @property
    def way(self) -> float | None:
        """Mean of `between`, dB."""
        return fmean(self.between.values()) if self.between else None


@dataclass(frozen=True)
class VariantRow:
    """Results of one variant of one run."""

    outcomes: Sequence[Outcome]  # one per seed, at least one

    @property
    def first(self) -> Outcome:
        """Outcome with the run's own seed."""
        return self.outcomes[0]

    @property
    def failed(self) -> str:
        """Reason if there are no figures, else ""."""
        return next((outcome.failed for outcome in self.outcomes if outcome.failed), "")

    def values(self, figure: Callable[[Outcome], float | None]) -> list[float]:
        """Return a figure for each seed, without seeds that lack it."""
        found = [] if self.failed else [figure(outcome) for outcome in self.outcomes]
        return [value for value in found if value is not None]


@dataclass(frozen=True)
class Ablation:
    """All finished variants of one run."""

    name: str  # name of the run
    title: str  # one line
    note: str  # description of the measurement, one line
    rows: Sequence[VariantRow]  # in order
    perceptual: str  # name of the distance, LPIPS or its substitute


@dataclass(frozen=True)
class Figure:
    """A column of the table."""

    heading: str  # heading with unit
    short: str  # heading on the terminal
    digits: int  # decimal places
    of: Callable[[Outcome], float | None]  # reads the figure

    def text(self, row: VariantRow, spread: bool = True) -> str:
        """Format the mean over the seeds, with ± the standard deviation if there are several."""
        values = row.values(self.of)
        if not values:
            return "–"
        mean = f"{fmean(values):.{self.digits}f}"
        return f"{mean} ± {stdev(values):.{self.digits}f}" if spread and len(values) > 1 else mean


FIGURES = (
    Figure("end, dB", "end", 1, lambda outcome: outcome.psnr),
    Figure("between, dB", "between", 1, lambda outcome: outcome.way),
    Figure("LPIPS", "LPIPS", 4, lambda outcome: outcome.lpips),
    Figure("even", "even", 2, lambda outcome: outcome.uniformity),
    Figure("t50", "t50", 2, lambda outcome: outcome.t50),
    Figure("t90", "t90", 2, lambda outcome: outcome.t90),
    Figure("bytes", "bytes", 0, lambda outcome: outcome.bytes_per_member),
    Figure("train, processor s", "s", 1, lambda outcome: outcome.seconds),
)


def rows_by_name(ablations: Sequence[Ablation]) -> Iterator[tuple[Outcome, list[VariantRow | None]]]:
    """Yield every variant of any run, in order, with its row of each run."""
    names = list(dict.fromkeys(row.first.name for ablation in ablations for row in ablation.rows))
    order = max((ablation.rows for ablation in ablations), key=len, default=())
    places = {row.first.name: i for i, row in enumerate(order)}
    for name in sorted(names, key=lambda name: places.get(name, len(places))):
        found = [
            next((row for row in ablation.rows if row.first.name == name), None) for ablation in ablations
        ]
        yield next(row.first for row in found if row is not None), found


def table_of(ablations: Sequence[Ablation], title: str) -> Table:
    """Make one table of the variants of all runs; a cell has a line for each run."""
    headings = tuple(figure.heading for figure in FIGURES)
    perceptual = ablations[0].perceptual
    columns = ("variant", "differs from", "by", "seeds", *headings)
    columns = tuple(perceptual if column == "LPIPS" else column for column in columns)
    rows = []
    failures = []
    for about, found in rows_by_name(ablations):
        cells = ["<br>".join("–" if row is None else figure.text(row) for row in found) for figure in FIGURES]
        seeds = dict.fromkeys(str(len(row.outcomes)) for row in found if row is not None)
        rows.append((about.name, about.of, about.what, "<br>".join(seeds), *cells))
        failures += [f"{about.name}: {row.failed}." for row in found if row is not None and row.failed]
    runs = [f"{ablation.name}: {ablation.note}" for ablation in ablations]
    note = (
        "On held-out views, over the pixels that show the region. End: the finished edit against the edited "
        "views. Between: mean over slider values near 0.25, 0.5 and 0.75 against the editor's pictures (–: "
        "there are none). Even: smallest over largest visible change of 20 equal steps. t50, t90: slider "
        "value at 50 and 90 % of the change. Bytes: of the field, per member. Seconds: of the optimization "
        "only. ± is the standard deviation over the seeds; variants that solve for colors use no seed and "
        "are trained once."
    )
    if len(ablations) > 1:
        note += f" A cell's lines: {', '.join(ablation.name for ablation in ablations)}."
    return Table("ablation", title, columns, tuple(rows), " ".join([note, *runs, *failures, f"{machine()}."]))


def print_table(ablation: Ablation) -> None:
    """Print the means of one run, within 80 columns."""
    drawn = RichTable(title=ablation.title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    for i, column in enumerate(("variant", *(figure.short for figure in FIGURES))):
        drawn.add_column(column, justify="left" if i == 0 else "right", no_wrap=True)
    for row in ablation.rows:
        drawn.add_row(row.first.name, *(figure.text(row, spread=False) for figure in FIGURES))
    console = Console(highlight=False)
    console.print(drawn)
    for row in ablation.rows:
        if row.failed:
            console.print(f"{row.first.name}: {row.failed}", soft_wrap=True)


def sheet_of(
    editor: Sequence[Tensor],
    rows: Sequence[VariantRow],
    strips: Mapping[str, Sequence[Tensor]],
    columns: Columns,
    title: str,
    caption: str,
) -> Tensor:
    """Draw the picture of a run: a row per variant, with the editor's pictures on top.

    Args:
        editor: the editor's pictures of the drawn view, at five strengths. [h,w,3] each
        rows: variants in order
        strips: their pictures with the run's own seed, by name, of the same size
        columns: slider values of the run
        title: line above
        caption: line below
    """
    drawn = [row for row in rows if row.first.name in strips]
    return contact_sheet(
        [editor, *(strips[row.first.name] for row in drawn)],
        ["the editor", *(f"{row.first.name}\n{row_line(row)}" for row in drawn)],
        [column_heading(*column) for column in columns],
        title,
        caption,
    )


def row_line(row: VariantRow) -> str:
    """Summarize a row by its two main figures: PSNR at the end and between."""
    end, between = (figure.text(row, spread=False) for figure in FIGURES[:2])
    return f"end {end}" + (f", between {between}" if between != "–" else "") + " dB"
