"""Renew the figures of the README from the pages that it cites: `python assets/figures.py`.

A figure in the README stands between `<!-- figure NAME -->` and `<!-- end -->`. It is read from a table of
docs/benchmarks.md or docs/speed-and-error.md, so that the README and its sources cannot differ.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
_FIGURE = re.compile(r"(<!-- figure (\w+) -->).*?(<!-- end -->)", re.DOTALL)

Row = list[str]


def table_row(page: str, heading: str, start: tuple[str, ...]) -> Row:
    """Return the cells of the first table row after `heading` whose first cells are `start`.

    Raises:
        LookupError: the page has no such heading or row.
    """
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    _, found, below = text.partition(heading)
    if not found:
        raise LookupError(f"docs/{page} has no '{heading}'")
    for line in below.splitlines():
        cells = [cell.strip().replace("**", "") for cell in line.strip("|").split("|")]
        if tuple(cells[: len(start)]) == start:
            return cells
    raise LookupError(f"docs/{page} has no row {start} below '{heading}'")


def _decibels(cell: str) -> list[str]:
    return re.findall(r"\d+\.\d+", cell)


def _robot() -> Row:
    return table_row("benchmarks.md", "## The edits of the front page", ("body to blue",))


def _robot_path() -> str:
    quarter, half, three_quarters, _ = _decibels(_robot()[3])[:4]
    return f"{quarter}, {half} and {three_quarters}"


def _robot_keyframes() -> str:
    quarter, half, three_quarters, _ = _decibels(_robot()[4])[:4]
    return f"{quarter}, {half} and {three_quarters}"


def _slider_step() -> str:
    row = table_row("speed-and-error.md", "<!-- bench compose -->", ("3000 / 30000",))
    exact = "bit for bit as the plain version" if row[9] == "0" else f"largest difference {row[9]}"
    return f"{row[4]} ms on one thread, {exact}"


def _slider_event() -> str:
    start = ("31 000", "3 000", "color")
    milliseconds = {}
    for engine in ("CPU", "OpenGL"):
        row = table_row("speed-and-error.md", "<!-- bench viewer -->", (*start, engine))
        milliseconds[engine] = row[9].partition(" / ")[0]
    return f"{milliseconds['CPU']} ms (CPU engine), {milliseconds['OpenGL']} ms (OpenGL by llvmpipe)"


def _rasterizer() -> str:
    row = table_row("speed-and-error.md", "<!-- bench rasterize -->", ("20 000", "256²", "2"))
    forward = row[3].partition(" ")[0]
    both = row[4].partition(" ")[0]
    return f"{forward} ms forward, {both} ms with gradients, image error {row[9]}"


def _turning() -> str:
    row = table_row("speed-and-error.md", "<!-- bench moving -->", ("1 000 000",))
    frame = row[2].partition(" / ")[0]
    sharp = row[5].partition(" ")[0]
    return f"{frame} ms a frame at {row[8]} dB, sharp {sharp} ms after the mouse stops"


FIGURES: dict[str, Callable[[], str]] = {
    "robot_end": lambda: _decibels(_robot()[3])[3],
    "robot_path": _robot_path,
    "robot_keyframes": _robot_keyframes,
    "slider_step": _slider_step,
    "slider_event": _slider_event,
    "rasterizer": _rasterizer,
    "turning": _turning,
}
"""Name of a figure in the README → the function that reads it from its page."""


def with_figures(text: str) -> str:
    """Return the README's text with every figure renewed.

    Raises:
        KeyError: a figure's name is not in `FIGURES`.
    """
    return _FIGURE.sub(lambda match: f"{match[1]}{FIGURES[match[2]]()}{match[3]}", text)


if __name__ == "__main__":
    README.write_text(with_figures(README.read_text(encoding="utf-8")), encoding="utf-8")
