"""What a batch tells: lines while it runs, batch.csv, and batch.html with pictures and curves."""

from __future__ import annotations

import base64
import csv
import io
import json
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from html import escape
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from progdf.errors import ProgdfError
from progdf.io.atomic import atomic_write
from progdf.io.json_values import decode_json
from progdf.terminal import escape_text, file_size, group_digits
from trainer.store.run_folder import RunFolder

from .jobs import Job
from .worker import PREVIEW, PREVIEW_SIDE, Outcome

CSV, PAGE = "batch.csv", "batch.html"
_LINES = 12  # of running jobs on a terminal
_EVENT_S = 2.0  # between two progress events
_SPARK_WIDTH, _SPARK_HEIGHT = 96, 28


@dataclass(frozen=True)
class Row:
    """One job in batch.csv and batch.html."""

    job: str
    status: str  # done, failed, stopped, or waiting
    reason: str = ""  # why it is not done
    psnr_end: float | None = None  # of the edit, to the editor's pictures on held-out views, dB
    psnr_between: float | None = None  # the worst strength in between, dB
    members: int | None = None  # Gaussians of the region
    bytes: int | None = None  # of the .gdf
    bytes_per_gaussian: float | None = None  # of the region
    seconds: float | None = None  # of the run, over all its sessions
    cpu_seconds: float | None = None  # of the session that ended it, all threads
    memory_mb: int | None = None  # peak
    attempts: int = 0  # how often it was begun
    host: str = ""
    folder_bytes: int | None = None  # of all that the run left

    @property
    def line(self) -> str:
        """For a screen."""
        if self.status != "done":
            return f"{self.job}: {self.status}{': ' if self.reason else ''}{self.reason}"
        between = "" if self.psnr_between is None else f", {self.psnr_between:.1f} at worst in between"
        end = "" if self.psnr_end is None else f"{self.psnr_end:.1f} dB{between}, "
        return f"{self.job}: {end}{file_size(self.bytes or 0)}, {self.seconds or 0:.0f} s"


def make_row(job: Job, outcome: Outcome) -> Row:
    """The row of a job that ended, with what its run's report tells."""
    row = Row(
        job.key,
        "done" if outcome.status == "done" else "stopped" if outcome.status == "stopped" else "failed",
        outcome.reason,
        seconds=round(outcome.seconds, 2),
        cpu_seconds=round(outcome.cpu_seconds, 2),
        attempts=outcome.attempts,
        host=outcome.host,
    )
    if row.status != "done":
        return row
    report, course = read_report(job), slider_course(read_report(job))
    size = sum(path.stat().st_size for path in job.options.out.rglob("*") if path.is_file())
    file = report.get("file", {})
    return replace(
        row,
        psnr_end=report.get("edit", {}).get("psnr_to_views"),
        psnr_between=min((psnr for s, psnr in course if s < 1), default=None),
        members=outcome.members,
        bytes=file.get("bytes"),
        bytes_per_gaussian=file.get("bytes_per_gaussian"),
        seconds=report.get("time", {}).get("total"),
        memory_mb=report.get("memory_mb"),
        folder_bytes=size,
    )


def read_report(job: Job) -> dict[str, Any]:
    """A run's report.json; empty where it is absent or broken."""
    with suppress(OSError, ValueError):
        report = decode_json(RunFolder(job.options.out).report.read_bytes())
        if isinstance(report, dict):
            return report
    return {}


def slider_course(report: Mapping[str, Any]) -> list[tuple[float, float]]:
    """Slider value and PSNR to the editor's pictures there, dB."""
    curve = report.get("curves", {}).get("against_editor", {}).get("slider", {})
    return list(zip(curve.get("s", []), curve.get("psnr", []), strict=False))


def read_rows(out: Path) -> dict[str, Row]:
    """The rows of an earlier session by job; none where there was none.

    Raises:
        ProgdfError: batch.csv is damaged.
    """
    path = out / CSV
    if not path.is_file():
        return {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [_parse_row(record) for record in csv.DictReader(file)]
    except (ValueError, KeyError, TypeError, OSError, csv.Error) as error:
        raise ProgdfError(f"{path} is damaged ({error}); delete it, the runs are not lost") from None
    return {row.job: row for row in rows}


def _parse_row(record: Mapping[str, str]) -> Row:
    parse = {"str": str, "int": int, "int | None": int, "float | None": float}
    values = {
        field.name: parse[str(field.type)](record[field.name])
        for field in fields(Row)
        if record[field.name] or field.type == "str"
    }
    return Row(**values)


def write_rows(out: Path, rows: Sequence[Row]) -> None:
    """Write batch.csv, whole or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Row)])
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    with atomic_write(out / CSV) as temporary_file:
        temporary_file.write_text(text.getvalue(), encoding="utf-8")


def write_page(out: Path, jobs: Mapping[str, Job], rows: Sequence[Row]) -> None:
    """Write batch.html: one file that fetches nothing."""
    done = sum(row.status == "done" for row in rows)
    failed = sum(row.status == "failed" for row in rows)
    summary = f"{done} of {len(rows)} done" + (f", {failed} failed" if failed else "")
    body = "\n".join(_html_row(row, jobs.get(row.job)) for row in rows)
    page = _PAGE.replace("{summary}", escape(summary)).replace("{rows}", body)
    with atomic_write(out / PAGE) as temporary_file:
        temporary_file.write_text(page, encoding="utf-8")


def _html_row(row: Row, job: Job | None) -> str:
    scene, _, name = row.job.rpartition("/")
    cells = [
        f'<td class="p">{_picture(job)}</td>',
        f"<td>{escape(scene)}</td><td>{_link(row, name)}</td>",
        _number(row.psnr_end, 1),
        _number(row.psnr_between, 1),
        f"<td>{_sparkline(slider_course(read_report(job))) if job and row.status == 'done' else ''}</td>",
        _number(row.members, 0, group_digits(row.members) if row.members else ""),
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


def _link(row: Row, name: str) -> str:
    href = escape(f"{row.job}/report.png".replace("%", "%25").replace("#", "%23").replace("?", "%3F"), True)
    return f'<a href="{href}">{escape(name)}</a>' if row.status == "done" else escape(name)


def _picture(job: Job | None) -> str:
    with suppress(OSError, AttributeError):
        content = (job.options.out / PREVIEW).read_bytes()  # type: ignore[union-attr]
        data = base64.b64encode(content).decode()
        return f'<img alt="at one half and at 1" src="data:image/jpeg;base64,{data}">'
    return ""


def _sparkline(course: Sequence[tuple[float, float]]) -> str:
    """PSNR over the slider as a small curve; its height is what this row spans, at least 3 dB."""
    if len(course) < 2:
        return ""
    low, high = min(p for _, p in course), max(p for _, p in course)
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
    """What a batch says while it runs: a live list on a terminal, lines elsewhere, or JSON events.

    Args:
        jobs: by key
        seconds: how long each is expected to take; what has ended corrects it
        workers: how many run at once
        events: one JSON object a line on stdout instead
    """

    def __init__(
        self, jobs: Mapping[str, Job], seconds: Mapping[str, float], workers: int, events: bool
    ) -> None:
        self._jobs, self._seconds, self._workers, self._events = jobs, seconds, workers, events
        self._console = Console(stderr=not events, highlight=False)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._is_live = self._console.is_terminal and not events
        self._rows: list[Row] = []
        self._told = 0.0

    def __enter__(self) -> Screen:
        if self._is_live:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._is_live:
            self._live.stop()

    def say(self, line: str) -> None:
        """One line."""
        if not self._events:
            self._console.print(escape_text(line), soft_wrap=True, markup=False)

    def event(self, name: str, **values: object) -> None:
        """One JSON line, where these are asked for."""
        if self._events:
            print(json.dumps({"event": name, **values}, ensure_ascii=False), flush=True)

    def end(self, row: Row) -> None:
        """A job ended."""
        self._rows.append(row)
        self.event("end", **asdict(row))
        self.say(row.line)

    def tick(self, running: Sequence[str]) -> None:
        """A few times a second, with the jobs that run."""
        if not self._is_live and time.monotonic() - self._told < _EVENT_S:
            return
        self._told = time.monotonic()
        if not self._is_live and not self._events:
            return
        states = {key: _progress(self._jobs[key]) for key in running[:_LINES]}
        left = self.remaining(running)
        if self._events:
            self.event(
                "progress", running=states, ended=len(self._rows), jobs=len(self._jobs), seconds_left=left
            )
            return
        text = Text()
        for key, state in states.items():
            share, seconds = state.get("share", 0.0), state.get("seconds", 0.0)
            more = f"{seconds / share * (1 - share):4.0f} s left" if share > 0.1 else ""
            text.append(f"  {escape_text(key):<40} {share:4.0%} {state.get('label', ''):<20} {more}\n", "dim")
        failed = sum(row.status == "failed" for row in self._rows)
        text.append(
            f"{len(self._rows)} of {len(self._jobs)} ended" + (f", {failed} failed" if failed else "")
        )
        text.append(f", about {duration(left)} left" if left else "")
        self._live.update(text, refresh=True)

    def remaining(self, running: Sequence[str]) -> float | None:
        """Seconds until all have ended, from the jobs that have; None before the first."""
        ended = [row for row in self._rows if row.seconds and row.job in self._seconds]
        expected = sum(self._seconds[row.job] for row in ended)
        if not expected:
            return None
        factor = sum(row.seconds or 0.0 for row in ended) / expected
        over = {row.job for row in self._rows}
        left = sum(s * (0.5 if key in running else 1) for key, s in self._seconds.items() if key not in over)
        return factor * left / max(1, self._workers)


def duration(seconds: float) -> str:
    """Seconds for a person: "40 s", "12 min", "3.5 h"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _progress(job: Job) -> dict[str, Any]:
    with suppress(OSError, ValueError):
        state = decode_json(RunFolder(job.options.out).progress.read_bytes())
        if isinstance(state, dict):
            return {key: state.get(key) for key in ("share", "label", "seconds")}
    return {}


_PAGE = f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<title>ProGDF batch: {{summary}}</title>
<style>
:root {{ color-scheme: light dark; --line: #8883; --dim: #888; --blue: #3f7fd9; }}
body {{ font: 14px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1180px; padding: 0 1rem; }}
h1 {{ font-size: 1.25rem; font-weight: 600; }} h1 small {{ color: var(--dim); font-weight: 400; }}
table {{ border-collapse: collapse; width: 100%; }}
th {{ cursor: pointer; text-align: left; white-space: nowrap; position: sticky; top: 0; background: Canvas; }}
th.n, td.n {{ text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }}
th[aria-sort=ascending]::after {{ content: " ↑"; }} th[aria-sort=descending]::after {{ content: " ↓"; }}
th:focus-visible {{ outline: 2px solid var(--blue); }}
td, th {{ padding: .4rem .6rem; border-bottom: 1px solid var(--line); vertical-align: middle; }}
td.p {{ padding-left: 0; }} img {{ display: block; height: {PREVIEW_SIDE // 2}px; border-radius: 4px; }}
svg polyline {{ fill: none; stroke: var(--blue); stroke-width: 1.6; }}
td.failed {{ color: #c33; max-width: 22rem; }} td.done, td.waiting, td.stopped {{ color: var(--dim); }}
a {{ color: inherit; }}
</style>
<h1>ProGDF batch <small>{{summary}}</small></h1>
<table><thead><tr>
<th data-none></th><th tabindex="0">Scene</th><th tabindex="0">Edit</th>
<th class="n" tabindex="0" title="to the editor's pictures, held-out views">dB at 1</th>
<th class="n" tabindex="0" title="the worst strength in between">Worst between</th>
<th data-none title="dB over the slider">Slider</th>
<th class="n" tabindex="0">Gaussians</th><th class="n" tabindex="0">.gdf</th>
<th class="n" tabindex="0" title="all threads">Processor s</th><th tabindex="0">Status</th>
</tr></thead><tbody>
{{rows}}
</tbody></table>
<script>
const body = document.querySelector("tbody");
function sort(head) {{
  const column = head.cellIndex, up = head.getAttribute("aria-sort") !== "ascending";
  const value = row => {{
    const cell = row.cells[column], number = cell.dataset.v;
    return number === undefined ? cell.textContent : number === "" ? NaN : Number(number);
  }};
  const compare = (a, b) => {{
    const x = value(a), y = value(b);
    if (typeof x === "string") return up ? x.localeCompare(y) : y.localeCompare(x);
    return isNaN(x) - isNaN(y) || (up ? x - y : y - x);
  }};
  for (const other of document.querySelectorAll("th")) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  body.append(...[...body.rows].sort(compare));
}}
for (const head of document.querySelectorAll("th:not([data-none])")) {{
  head.addEventListener("click", () => sort(head));
  head.addEventListener("keydown", event => {{ if (event.key === "Enter") sort(head); }});
}}
</script>
</html>
"""
