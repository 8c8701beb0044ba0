"""Export the pages of docs/gallery.md: a page with live sliders for each exhibit.

usage: python docs/site/gallery.py OUT_FOLDER
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
from progdf.__main__ import main as progdf  # noqa: E402

EXAMPLES = ROOT / "viewer" / "examples"
SCENES = ROOT / "assets" / "scenes"
EDITS = ROOT / "assets" / "exhibits"
OWN = "A scene of ProGDF Studio, Apache-2.0"
ROBOT = "PLAYBOT by Stephane Agullo (sa3d.fr), CC-BY-4.0"
BOX = "Card box by Marcel Padilla, CC-BY-4.0"


@dataclass(frozen=True)
class Exhibit:
    """One page of the gallery."""

    name: str  # of its file, and of its picture in assets/exhibits
    title: str
    files: tuple[Path, ...]  # a scene and its edits, or a bundle
    credit: str
    options: tuple[str, ...] = ()  # of `progdf export`


def _bundle(name: str, title: str) -> Exhibit:
    return Exhibit(name, title, (EXAMPLES / f"{name}.progdf.zip",), OWN)


EXHIBITS = (
    _bundle("bear", "A bear in four coats"),
    _bundle("play", "A bear at play"),
    _bundle("room", "A room at dusk"),
    Exhibit(
        "box",
        "A card box with a badge",
        (SCENES / "box.sog", EDITS / "letters.gdf", EDITS / "logo.gdf"),
        BOX,
        ("--set", "letters=0.7"),
    ),
    Exhibit(
        "robot",
        "A robot in three colors",
        (SCENES / "robot.compressed.ply", *(EDITS / f"{color}.gdf" for color in ("blue", "green", "red"))),
        ROBOT,
        ("--set", "blue=1", "--set", "green=0", "--set", "red=0"),
    ),
    Exhibit(
        "pose",
        "A robot that waves",
        (SCENES / "robot.compressed.ply", EDITS / "tilt.gdf", EDITS / "wave.gdf"),
        ROBOT,
        ("--set", "tilt=0.6"),
    ),
)


def write_pages(folder: Path, exhibits: Sequence[Exhibit] = EXHIBITS) -> None:
    """Write NAME.html of each exhibit.

    Raises:
        SystemExit: a page could not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for exhibit in exhibits:
        page = folder / f"{exhibit.name}.html"
        words = ["--title", exhibit.title, "--credit", exhibit.credit, *exhibit.options]
        with tempfile.TemporaryDirectory() as unpacked:  # a bundle is unpacked into the folder that holds it
            files = [shutil.copy(file, unpacked) for file in exhibit.files]
            status = progdf(["export", *files, "-o", str(page), *words])
        if status:
            sys.exit(f"the page {exhibit.name} could not be written")


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]))
