"""Tables of benchmark results, for the terminal and for marked sections of Markdown files."""

from __future__ import annotations

import datetime
import hashlib
import os
import platform
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from statistics import fmean

BEGIN = "<!-- bench {name} -->"
END = "<!-- end {name} -->"

BUSY = 0.05
"""Share of the cores used by other processes above which wall times are meaningless."""

_SPIN_S = 0.3  # seconds of one load measurement
_LOAD_MEASUREMENTS = 3  # load measurements, of which the lowest counts


class Wall(str):
    """Heading of a column of wall times or of values that depend on them."""


@dataclass(frozen=True)
class Table:
    """One benchmark's result."""

    name: str  # short, for the markers and the JSON file
    title: str  # one line
    columns: tuple[str, ...]  # headings, with units
    rows: tuple[tuple[str, ...], ...]  # one text per column
    note: str = ""  # description of the measurement, one or two lines

    @classmethod
    def of(cls, name: str, title: str, rows: Sequence[Mapping[str, str]], note: str) -> Table:
        """Make a table of one or more rows, which map headings to texts."""
        return cls(name, title, tuple(rows[0]), tuple(tuple(row.values()) for row in rows), note)

    def markdown(self) -> str:
        """Format the table as GitHub Markdown, with its title and note."""
        lines = [f"**{self.title}**", "", "| " + " | ".join(self.columns) + " |"]
        lines.append("|" + " --- |" * len(self.columns))
        lines += ["| " + " | ".join(row) + " |" for row in self.rows]
        if self.note:
            lines += ["", self.note]
        return "\n".join(lines)

    def without_wall(self) -> Table:
        """Return the table with dashes in the columns headed by a `Wall`."""
        walls = [isinstance(column, Wall) for column in self.columns]
        rows = tuple(
            tuple("–" if w else cell for w, cell in zip(walls, row, strict=True)) for row in self.rows
        )
        return replace(self, rows=rows)


def mean_worst(values: Sequence[float]) -> str:
    """Format the mean and the lowest of values in dB; a dash without values."""
    return f"{fmean(values):.1f} / {min(values):.1f}" if values else "-"


def busy_share() -> float:
    """Return the share of the cores that other processes use, 0 to 1.

    A loop on every core measures the time that it does not get. The lowest of several measurements counts, as
    every machine has short background work.
    """
    block = bytes(1 << 20)  # hashing releases Python's global lock

    def spin(_: int) -> float:
        began = time.perf_counter()
        used = time.thread_time()
        while time.perf_counter() - began < _SPIN_S:
            hashlib.sha256(block)
        return (time.thread_time() - used) / (time.perf_counter() - began)

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with ThreadPoolExecutor(cores) as pool:
        return max(
            0.0, 1.0 - max(sum(pool.map(spin, range(cores))) / cores for _ in range(_LOAD_MEASUREMENTS))
        )


def machine() -> str:
    """Return one line that names the machine, its software and the day."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in cpuinfo.read_text("utf-8").splitlines()
            if "model name" in line
        ]
        model = names[0] if names else model
    versions = ", ".join(f"{name} {version(name)}" for name in ("torch", "numba"))
    python = f"Python {platform.python_version()}, {versions}, {platform.system()}"
    return f"{model}, {os.cpu_count()} cores, {python}, {today()}"


def today() -> str:
    """Return today's date, such as "3 May 2025"."""
    day = datetime.date.today()
    return f"{day.day} {day:%B %Y}"


def put_tables(text: str, tables: Sequence[Table]) -> str:
    """Replace the text between each table's markers, and the machine's line; skip tables without markers."""
    for name, filled in [("machine", machine()), *((table.name, table.markdown()) for table in tables)]:
        begin = BEGIN.format(name=name)
        end = END.format(name=name)
        if begin in text and end in text:
            head, rest = text.split(begin, 1)
            tail = rest.split(end, 1)[1]
            text = f"{head}{begin}\n{filled}\n{end}{tail}"
    return text
