"""Draw docs/architecture.svg, the packages and folders with their imports.

    python assets/architecture.py [FILE]

A box is a folder, or the files directly in a package. Each imports only boxes below it and boxes of `progdf`.
The number in a box is its lines, in thousands; the bar compares them with the largest folder.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from tests.helpers.sizes import dotted, importers, modules  # noqa: E402

PAGE = ROOT / "docs" / "architecture.svg"
PACKAGES = ("trainer", "progdf", "viewer")  # from left to right
COLORS = {"trainer": "#b4572a", "progdf": "#2f5f8f", "viewer": "#3d7a4a"}
TITLES = {
    "trainer": "trainer: edits views, trains the field",
    "progdf": "progdf: the library, no GL and no UI",
    "viewer": "viewer: window, web page, exports",
}
FILES = "files beside the folders"

COLUMN_PX = 330
GAP_PX = 120
BOX_PX = 44
STEP_PX = 54
TOP_PX = 84
FONT = "font-family='system-ui, sans-serif'"


@dataclass(frozen=True)
class House:
    """Folders of each package from the top, their lines, and the imports between packages."""

    folders: dict[str, list[str]]
    lines: Counter[tuple[str, str]]
    imports: Counter[tuple[str, str]]  # (importing, imported) package


def read_house() -> House:
    """Return the folders of the packages, in an order in which imports point down."""
    everything = {dotted(module.path): module for package in PACKAGES for module in modules(package)}
    boxes = {name: (module.path.parts[0], _folder(module.path)) for name, module in everything.items()}
    lines: Counter[tuple[str, str]] = Counter()
    for name, module in everything.items():
        lines[boxes[name]] += module.lines
    imports: Counter[tuple[str, str]] = Counter()
    above: dict[tuple[str, str], Counter[tuple[str, str]]] = {box: Counter() for box in lines}
    for target, users in importers(everything).items():
        for user in users:
            if boxes[user][0] != boxes[target][0]:
                imports[boxes[user][0], boxes[target][0]] += 1
            elif boxes[user] != boxes[target]:
                above[boxes[target]][boxes[user]] += 1
    folders = {package: _stack(package, above) for package in PACKAGES}
    return House(folders, lines, imports)


def _folder(path: Path) -> str:
    return path.parts[1] if len(path.parts) > 2 else FILES


def _stack(package: str, above: dict[tuple[str, str], Counter[tuple[str, str]]]) -> list[str]:
    """Return a package's folders from the top: first those that the fewest remaining ones import.

    The files beside the folders are the entry points and the smallest parts at once. They stand at the bottom
    of progdf and at the top of the others.
    """
    left = sorted(box for box in above if box[0] == package and box[1] != FILES)
    found = []
    while left:
        box = min(left, key=lambda box: sum(above[box][user] for user in left))
        found.append(box[1])
        left.remove(box)
    return [*found, FILES] if package == "progdf" else [FILES, *found]


def draw(house: House) -> str:
    """Return the picture as SVG."""
    height = TOP_PX + STEP_PX * max(map(len, house.folders.values())) + 96
    width = 3 * COLUMN_PX + 2 * GAP_PX + 40
    largest = max(house.lines.values())
    parts = [
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width} {height}' {FONT}>",
        f"<rect width='{width}' height='{height}' fill='#ffffff'/>",
        "<defs><marker id='tip' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='7' markerHeight='7' "
        "orient='auto'><path d='M0 0 L8 4 L0 8 z' fill='#555'/></marker></defs>",
    ]
    for column, package in enumerate(PACKAGES):
        left = 20 + column * (COLUMN_PX + GAP_PX)
        parts += _draw_package(house, package, left, largest)
    middle = height / 2 - 40
    for package, start, direction in (
        ("trainer", 20 + COLUMN_PX, 1),
        ("viewer", 20 + 2 * (COLUMN_PX + GAP_PX), -1),
    ):
        count = house.imports[package, "progdf"]
        end = start + direction * (GAP_PX - 6)
        parts.append(
            f"<path d='M{start} {middle} H{end}' stroke='#555' stroke-width='3' marker-end='url(#tip)'/>"
        )
        x = (start + end) / 2
        parts.append(_text(x, middle - 12, "imports", 15, "#333", "middle"))
        parts.append(_text(x, middle + 22, f"{count} times", 15, "#333", "middle"))
    parts += _draw_contract(width, height)
    return "\n".join([*parts, "</svg>\n"])


def _draw_package(house: House, package: str, left: float, largest: int) -> list[str]:
    """Return a package's title and boxes."""
    color = COLORS[package]
    parts = [_text(left, 48, TITLES[package], 16, color, weight="bold")]
    for row, folder in enumerate(house.folders[package]):
        top = TOP_PX + row * STEP_PX
        lines = house.lines[package, folder]
        bar = (COLUMN_PX - 8) * lines / largest
        parts += [
            f"<rect x='{left}' y='{top}' width='{COLUMN_PX}' height='{BOX_PX}' rx='6' fill='#f4f5f7' "
            f"stroke='{color}'/>",
            f"<rect x='{left + 4}' y='{top + BOX_PX - 9}' width='{bar:.0f}' height='5' rx='2' fill='{color}' "
            "opacity='0.5'/>",
            _text(left + 12, top + 26, folder if folder == FILES else f"{folder}/", 17, "#222"),
            _text(left + COLUMN_PX - 12, top + 26, f"{lines / 1000:.1f} k", 14, "#777", "end"),
        ]
    return parts


def _draw_contract(width: float, height: float) -> list[str]:
    """Return the files that trainer and viewer share, at the bottom."""
    top = height - 62
    label = "contract: .gdf file and run folder. The window trains by running `progdf train`."
    return [
        f"<rect x='20' y='{top}' width='{width - 40}' height='42' rx='6' fill='#fff7e0' stroke='#a08020'/>",
        _text(width / 2, top + 27, label, 17, "#5a4810", "middle"),
    ]


def _text(
    x: float, y: float, text: str, size: int, color: str, anchor: str = "start", weight: str = ""
) -> str:
    bold = f" font-weight='{weight}'" if weight else ""
    return (
        f"<text x='{x:g}' y='{y:g}' font-size='{size}' fill='{color}' text-anchor='{anchor}'{bold}>"
        f"{escape(text)}</text>"
    )


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else PAGE
    target.write_text(draw(read_house()), encoding="utf-8")
