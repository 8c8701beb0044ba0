"""`progdf bench`: run the benchmarks and print their tables, each speed beside its error."""

from __future__ import annotations

import importlib
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from progdf.command_line import parsed
from progdf.errors import ProgdfError
from progdf.files import written_whole

BEGIN, END = "<!-- bench {name} -->", "<!-- end {name} -->"


@dataclass(frozen=True)
class Table:
    """One benchmark's result.

    Args:
        name: short, for the README's markers and the JSON file
        title: one line
        columns: headings, with units
        rows: one text a column
        note: what was measured and how, one or two lines
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """The table as GitHub Markdown, with its title and note."""
        lines = [f"**{self.title}**", "", "| " + " | ".join(self.columns) + " |"]
        lines.append("|" + " --- |" * len(self.columns))
        lines += ["| " + " | ".join(row) + " |" for row in self.rows]
        if self.note:
            lines += ["", self.note]
        return "\n".join(lines)


@dataclass(frozen=True)
class Options:
    """Measure speed against error; each benchmark interleaves what it compares in one process.

    Args:
        what: rasterize, field, viewer, frames, window; all of them when none is named
        json: also write the tables to this JSON file
        readme: also put the tables between their markers in this Markdown file
        runs: finished run folders whose recorded edits `field` measures beside the bear's
        plot: `field` also draws its errors into this PNG file
        scenes: .ply files that viewer, frames and window draw in place of the bears
        seconds: how long `window` drags its slider; 60 where not said
    """

    what: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    json: Path | None = None
    readme: Path | None = None
    runs: tuple[Path, ...] = ()
    plot: Path | None = None
    scenes: tuple[Path, ...] = ()
    seconds: float | None = None


def machine() -> str:
    """One line that names the machine, for the tables."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}, {platform.system()}"


def main(argv: Sequence[str]) -> int:
    """Run the named benchmarks. Raises ProgdfError for a name that does not exist."""
    from progdf.__main__ import BENCHES, RECORDED  # the front door is the one file that knows all floors

    options = parsed(Options, argv, "progdf bench")
    for name in options.what:
        if name not in BENCHES:
            raise ProgdfError(f"there is no benchmark '{name}'; try one of {', '.join(BENCHES)}")
    if (options.runs or options.plot) and options.what and "field" not in options.what:
        raise ProgdfError("--runs and --plot are for fields; say progdf bench field")
    drawing = ("viewer", "frames", "window")
    if options.scenes and options.what and not set(drawing) & set(options.what):
        raise ProgdfError(f"--scenes are for {', '.join(drawing)}; say progdf bench {drawing[0]}")
    if options.seconds is not None and options.what and "window" not in options.what:
        raise ProgdfError("--seconds is how long the window is dragged; say progdf bench window")
    for output in (options.json, options.plot):  # told now, not when an hour has been measured
        if output is not None and not output.parent.is_dir():
            raise ProgdfError(f"the folder {output.parent} does not exist; make it first")
    if options.readme is not None and not options.readme.is_file():
        raise ProgdfError(f"{options.readme} does not exist; check the name and the folder")
    given: dict[str, dict[str, object]] = {"field": {"plot": options.plot}}
    if options.runs:
        given["field"]["recorded"] = [_named(RECORDED)(run) for run in options.runs]
    given |= {name: {"scenes": options.scenes} for name in drawing}
    if options.seconds is not None:
        given["window"]["seconds"] = options.seconds
    tables: list[Table] = []
    print(f"{machine()}\n")
    for name in options.what or tuple(BENCHES):
        try:
            measured = _named(BENCHES[name])(**given.get(name, {}))
        except ProgdfError as error:
            if options.what:
                raise
            print(f"{name} is not measured: {error}\n", file=sys.stderr)
            continue
        for table in measured:
            tables.append(table)
            print(table.markdown() + "\n", flush=True)
    if options.json:
        written = {"machine": machine(), "tables": [asdict(table) for table in tables]}
        with written_whole(options.json) as beside:
            beside.write_text(json.dumps(written, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    if options.readme:
        filled = put_tables(options.readme.read_text(encoding="utf-8"), tables)
        with written_whole(options.readme) as beside:
            beside.write_text(filled, encoding="utf-8")
    return 0


def _named(path: str) -> Callable[..., Any]:
    """The function of a floor that this one does not know, by "module:name"."""
    module, function = path.split(":")
    found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return found


def put_tables(text: str, tables: Sequence[Table]) -> str:
    """`text` with every table placed between its markers; a table without markers is left out."""
    for table in tables:
        begin, end = BEGIN.format(name=table.name), END.format(name=table.name)
        if begin in text and end in text:
            head, rest = text.split(begin, 1)
            tail = rest.split(end, 1)[1]
            text = f"{head}{begin}\n{table.markdown()}\n{end}{tail}"
    return text
