"""A benchmark's result as a table, on the terminal and between the markers of a Markdown file."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

BEGIN, END = "<!-- bench {name} -->", "<!-- end {name} -->"


@dataclass(frozen=True)
class Table:
    """One benchmark's result."""

    name: str  # short, for the markers and the JSON file
    title: str  # one line
    columns: tuple[str, ...]  # headings, with units
    rows: tuple[tuple[str, ...], ...]  # one text a column
    note: str = ""  # what was measured and how, one or two lines

    def markdown(self) -> str:
        """The table as GitHub Markdown, with its title and note."""
        lines = [f"**{self.title}**", "", "| " + " | ".join(self.columns) + " |"]
        lines.append("|" + " --- |" * len(self.columns))
        lines += ["| " + " | ".join(row) + " |" for row in self.rows]
        if self.note:
            lines += ["", self.note]
        return "\n".join(lines)


def machine() -> str:
    """One line that names the machine, for the tables."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in cpuinfo.read_text("utf-8").splitlines()
            if "model name" in line
        ]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, {platform.system()}"


def put_tables(text: str, tables: Sequence[Table]) -> str:
    """`text` with every table placed between its markers; a table without markers is left out."""
    for table in tables:
        begin, end = BEGIN.format(name=table.name), END.format(name=table.name)
        if begin in text and end in text:
            head, rest = text.split(begin, 1)
            tail = rest.split(end, 1)[1]
            text = f"{head}{begin}\n{table.markdown()}\n{end}{tail}"
    return text
