"""Reports of a batch: lines while it runs, batch.csv, and batch.html with pictures and curves."""

from __future__ import annotations

import base64
import csv
import io
import json
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from html import escape
from pathlib import Path
from typing import Annotated, Literal, TextIO

import msgspec
from rich.console import Console
from rich.live import Live
from rich.text import Text

from progdf.errors import ProgdfError
from progdf.io.atomic import read_file, write_file
from progdf.io.json_values import convert_json, decode_json, to_json
from progdf.terminal import escape_text, file_size, format_count, format_duration
from trainer.store.run_folder import RunFolder

from .jobs import BatchJob

Status = Literal["done", "failed", "stopped", "memory", "waiting"]

SOME_FAILED = 3
"""Exit status if some jobs failed."""

CSV = "batch.csv"
PAGE = "batch.html"
PREVIEW = "preview.jpg"
"""Picture in a run's folder: the edit at strengths 0.5 and 1, side by side."""
_MAX_LIVE_LINES = 12  # running jobs listed on a terminal
_EVENT_INTERVAL_S = 2.0  # between two progress events
_SPARK_WIDTH = 96  # pixels
_SPARK_HEIGHT = 28  # pixels
_MAX_EMBEDDED = 1000  # more pictures, about 15 kB each, are linked instead of embedded in the page


@dataclass(frozen=True)
class JobRow:
    """Result of a job: one line of batch.csv and batch.html."""

    job: str  # key of the job
    status: Status  # stopped: by Ctrl-C; memory: ran out of memory and is restarted
    reason: str = ""  # reason why the job is not done, in one line
    psnr_end: float | None = None  # full edit against the editor's pictures on held-out views, dB
    psnr_between: float | None = None  # worst strength below 1, dB
    bytes: int | None = None  # size of the .gdf
    bytes_per_gaussian: float | None = None  # size per Gaussian of the region
    seconds: float | None = None  # duration over all sessions of the run
    cpu_seconds: float | None = None  # CPU time of the last session, all threads
    memory_mb: int | None = None  # peak memory
    folder_bytes: int | None = None  # size of the run folder
    attempts: int = 1  # number of starts
    host: str = ""  # name of the machine

    @property
    def line(self) -> str:
        """One-line summary for the terminal."""
        if self.status != "done":
            return f"{self.job}: {self.status}{': ' if self.reason else ''}{self.reason}"
        between = "" if self.psnr_between is None else f", worst in between {self.psnr_between:.1f} dB"
        end = "" if self.psnr_end is None else f"{self.psnr_end:.1f} dB{between}, "
        return f"{self.job}: {end}{file_size(self.bytes or 0)}, {self.seconds or 0:.0f} s"


@dataclass(frozen=True)
class SliderCurve:
    """PSNR along the slider against the editor's pictures."""

    s: tuple[float, ...] = ()  # slider values
    psnr: tuple[float, ...] = ()  # dB, one per slider value


@dataclass(frozen=True)
class EditorCurves:
    """Curves against the editor's pictures."""

    slider: SliderCurve = SliderCurve()  # the shipped field


@dataclass(frozen=True)
class Curves:
    """Curves of a report."""

    against_editor: EditorCurves = EditorCurves()


@dataclass(frozen=True)
class EditFigures:
    """Figures of the finished edit."""

    psnr_to_views: float | None = None  # against the editor's pictures on held-out views, dB


@dataclass(frozen=True)
class FileFigures:
    """Figures of the .gdf file."""

    bytes: int | None = None
    bytes_per_gaussian: float | None = None


@dataclass(frozen=True)
class TimeFigures:
    """Durations of a run, seconds."""

    total: float | None = None  # over all its sessions


@dataclass(frozen=True)
class RunReport:
    """The parts of a run's report.json that a batch shows; all of them may be absent."""

    edit: EditFigures = EditFigures()
    file: FileFigures = FileFigures()
    time: TimeFigures = TimeFigures()
    memory_mb: int | None = None  # peak
    curves: Curves = Curves()

    @property
    def course(self) -> list[tuple[float, float]]:
        """Pairs of a slider value and the PSNR to the editor's pictures there, dB."""
        curve = self.curves.against_editor.slider
        return list(zip(curve.s, curve.psnr, strict=False))


@dataclass(frozen=True)
class BatchProgress:
    """Progress of a run; the trainer writes it to RUN/state/progress.json."""

    share: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0  # elapsed share of its whole time
    label: str = ""  # the present stage
    loss: str = ""
    seconds: Annotated[float, msgspec.Meta(ge=0.0, le=1e9)] = 0.0  # over all sessions of the run


def finished_row(job: BatchJob) -> JobRow:
    """Return the row of a finished run, from its folder.

    Raises:
        ProgdfError: its report.json is damaged.
    """
    report = read_report(job)
    root = job.options.out
    return JobRow(
        job.key,
        "done",
        psnr_end=report.edit.psnr_to_views,
        psnr_between=min((psnr for s, psnr in report.course if s < 1), default=None),
        bytes=report.file.bytes,
        bytes_per_gaussian=report.file.bytes_per_gaussian,
        seconds=report.time.total,
        memory_mb=report.memory_mb,
        folder_bytes=sum(path.stat().st_size for path in root.rglob("*") if path.is_file()),
    )


def read_report(job: BatchJob) -> RunReport:
    """Return the parts of a run's report.json that a batch shows.

    Raises:
        ProgdfError: it cannot be read, or is damaged.
    """
    path = RunFolder(job.options.out).report
    try:
        return convert_json(decode_json(read_file(path)), RunReport)
    except ProgdfError:
        raise
    except ValueError as error:
        raise ProgdfError(
            f"{path} is damaged ({error}); remove {job.options.out} to train it again"
        ) from None


def _read_progress(job: BatchJob) -> BatchProgress:
    """Return the progress of a job; zero progress if the file is missing or damaged."""
    with suppress(OSError, ValueError):
        path = RunFolder(job.options.out).progress
        return convert_json(decode_json(path.read_bytes()), BatchProgress)
    return BatchProgress()


def read_rows(out: Path) -> dict[str, JobRow]:
    """Return the rows of an earlier session by job; empty without one.

    Raises:
        ProgdfError: batch.csv is damaged.
    """
    path = out / CSV
    if not path.is_file():
        return {}
    try:
        records = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
        filled = [{key: value for key, value in record.items() if value} for record in records]
        rows = [msgspec.convert(values, JobRow, strict=False) for values in filled]
    except (ValueError, TypeError, csv.Error) as error:
        raise ProgdfError(f"{path} is damaged ({error}); delete it, the runs are not lost") from None
    return {row.job: row for row in rows}


def write_rows(out: Path, rows: Sequence[JobRow]) -> None:
    """Write batch.csv atomically."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(JobRow)])
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    write_file(out / CSV, text.getvalue())


def write_page(out: Path, rows: Sequence[JobRow], jobs: Sequence[BatchJob]) -> None:
    """Write batch.html, a self-contained page; beyond 1000 rows it links the pictures in the run folders."""
    done = sum(row.status == "done" for row in rows)
    failed = sum(row.status == "failed" for row in rows)
    summary = f"{done} of {len(rows)} done" + (f", {failed} failed" if failed else "")
    embed = len(rows) <= _MAX_EMBEDDED
    by_key = {job.key: job for job in jobs}
    body = "\n".join(_html_row(row, by_key.get(row.job), embed) for row in rows)
    page = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    page = page.replace("{summary}", escape(summary)).replace("{rows}", body)
    write_file(out / PAGE, page)


def _html_row(row: JobRow, job: BatchJob | None, embed: bool) -> str:
    scene, _, name = row.job.rpartition("/")
    cells = [
        f'<td class="p">{_picture(row, job, embed)}</td>',
        f"<td>{escape(scene)}</td><td>{_link(row, name)}</td>",
        _number(row.psnr_end, 1),
        _number(row.psnr_between, 1),
        f"<td>{_course_picture(row, job)}</td>",
        _number(row.bytes, 0, file_size(row.bytes) if row.bytes else ""),
        _number(row.cpu_seconds, 0),
        f'<td class="{escape(row.status)}">{escape(row.status)}'
        f"{'<br><small>' + escape(row.reason) + '</small>' if row.reason else ''}</td>",
    ]
    return f"<tr>{''.join(cells)}</tr>"


def _number(value: float | None, digits: int, text: str = "") -> str:
    if value is None:
        return '<td class="n" data-v=""></td>'
    return f'<td class="n" data-v="{value}">{escape(text or f"{value:.{digits}f}")}</td>'


def _link(row: JobRow, name: str) -> str:
    if row.status != "done":
        return escape(name)
    return f'<a href="{_address(row, "report.png")}">{escape(name)}</a>'


def _address(row: JobRow, file: str) -> str:
    return escape(f"{row.job}/{file}".replace("%", "%25").replace("#", "%23").replace("?", "%3F"), True)


def _picture(row: JobRow, job: BatchJob | None, embed: bool) -> str:
    if job is None or not (job.options.out / PREVIEW).is_file():
        return ""
    source = _address(row, PREVIEW)
    if embed:
        content = (job.options.out / PREVIEW).read_bytes()
        source = f"data:image/jpeg;base64,{base64.b64encode(content).decode()}"
    return f'<img loading="lazy" alt="at one half and at 1" src="{source}">'


def _course_picture(row: JobRow, job: BatchJob | None) -> str:
    """Return the curve of a finished job; "" if its report is damaged or was removed meanwhile."""
    if job is None or row.status != "done":
        return ""
    with suppress(ProgdfError):
        return _sparkline(read_report(job).course)
    return ""


def _sparkline(course: Sequence[tuple[float, float]]) -> str:
    """Return PSNR over the slider as a small SVG curve; its height spans this row's range, at least 3 dB."""
    if len(course) < 2:
        return ""
    low = min(p for _, p in course)
    high = max(p for _, p in course)
    span = max(high - low, 3.0)
    points = " ".join(
        f"{2 + s * (_SPARK_WIDTH - 4):.1f},{2 + (high - psnr) / span * (_SPARK_HEIGHT - 4):.1f}"
        for s, psnr in course
    )
    return (
        f'<svg width="{_SPARK_WIDTH}" height="{_SPARK_HEIGHT}"><title>{low:.1f} to {high:.1f} dB</title>'
        f'<polyline points="{points}"/></svg>'
    )


class Screen:
    """Output of a running batch: a live list on a terminal, lines elsewhere, or JSON events.

    Args:
        jobs: jobs that will run, by key
        seconds: expected duration of each, corrected by those of finished jobs
        workers: number of jobs that run at once
        events: destination of JSON events, one object per line, instead of text
    """

    def __init__(
        self,
        jobs: Mapping[str, BatchJob],
        seconds: Mapping[str, float],
        workers: int,
        events: TextIO | None = None,
    ) -> None:
        self._jobs = jobs
        self._seconds = seconds
        self._workers = workers
        self._events = events
        self._console = Console(stderr=True, highlight=False, quiet=events is not None)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._rows: list[JobRow] = []
        self._begun = time.monotonic()
        self._updated_at = 0.0

    def say(self, line: str) -> None:
        """Print one line."""
        self._console.print(escape_text(line), soft_wrap=True, markup=False)

    def event(self, name: str, **values: object) -> None:
        """Write one JSON line if events are requested."""
        if self._events is not None:
            print(json.dumps({"event": name, **values}, ensure_ascii=False), file=self._events, flush=True)

    def end(self, row: JobRow) -> None:
        """Report the end of a job."""
        self._rows.append(row)
        self.event("end", **asdict(row))
        self.say(row.line)

    def tick(self, running: Sequence[str]) -> None:
        """Report progress; called a few times a second with the keys of the running jobs."""
        live = self._console.is_terminal and self._events is None
        if not live and (self._events is None or time.monotonic() - self._updated_at < _EVENT_INTERVAL_S):
            return
        self._updated_at = time.monotonic()
        states = {key: _read_progress(self._jobs[key]) for key in running[:_MAX_LIVE_LINES]}
        remaining = self._remaining(running)
        ended = len(self._rows)
        failed = sum(row.status == "failed" for row in self._rows)
        self.event("progress", running=to_json(states), ended=ended, failed=failed, seconds_left=remaining)
        if live:
            lines = [f"  {key:<40} {_state(state)}" for key, state in states.items()]
            time_left = f", about {format_duration(remaining)} left" if remaining else ""
            lines.append(f"{ended} of {len(self._jobs)} ended, {failed} failed{time_left}")
            self._live.start()
            self._live.update(Text("\n".join(map(escape_text, lines))), refresh=True)

    def total(self, rows: Sequence[JobRow], out: Path) -> int:
        """Report the totals of all selected jobs and return the exit status."""
        statuses = [row.status for row in rows]
        seconds = time.monotonic() - self._begun
        done = statuses.count("done")
        failed = statuses.count("failed")
        self.event("total", done=done, failed=failed, jobs=len(rows), seconds=seconds)
        self.say(
            f"{done} of {format_count(len(rows), 'job')} done{f', {failed} failed' if failed else ''} "
            f"in {format_duration(seconds)}; see {out / PAGE} and {CSV}"
        )
        return SOME_FAILED if failed else 0

    def close(self) -> None:
        """Remove the live list from the terminal."""
        self._live.stop()

    def _remaining(self, running: Sequence[str]) -> float | None:
        """Return the seconds until all jobs have ended, from the ended ones; None before the first."""
        ended = {row.job: row.seconds for row in self._rows if row.seconds and row.job in self._seconds}
        expected = sum(self._seconds[key] for key in ended)
        if not expected:
            return None
        ended_keys = {row.job for row in self._rows}
        ahead = sum(
            s * (0.5 if key in running else 1) for key, s in self._seconds.items() if key not in ended_keys
        )
        return sum(ended.values()) / expected * ahead / self._workers


def _state(state: BatchProgress) -> str:
    time_left = ""
    if state.share > 0.1:
        time_left = f"{format_duration(state.seconds / state.share * (1 - state.share))} left"
    return f"{state.share:4.0%} {state.label:<20} {time_left}"
