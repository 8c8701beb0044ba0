"""Build the gallery of the site: a page with live sliders for each example, and a page that lists them.

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


@dataclass(frozen=True)
class Exhibit:
    """One page of the gallery."""

    bundle: Path  # NAME.progdf.zip; its thumbnail is NAME.jpg beside it
    title: str
    text: str  # what to try, one sentence
    credit: str = "A scene of ProGDF Studio, Apache-2.0"

    @property
    def name(self) -> str:
        """Name of the page's file, without its suffix."""
        return self.bundle.name.partition(".")[0]


EXHIBITS = (
    Exhibit(
        EXAMPLES / "bear.progdf.zip",
        "A bear in four coats",
        "Blend frost, gold and panda; recolor the scarf alone.",
    ),
    Exhibit(
        EXAMPLES / "play.progdf.zip",
        "A bear at play",
        "Grow its head, bring its twin, take its scarf; P plays the film.",
    ),
    Exhibit(
        EXAMPLES / "room.progdf.zip", "A room at dusk", "Dim the light, then repaint the walls and the rug."
    ),
)


def write_gallery(folder: Path, exhibits: Sequence[Exhibit] = EXHIBITS) -> None:
    """Write NAME.html and NAME.jpg of each exhibit, and gallery.md.

    Raises:
        SystemExit: a page could not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lines = [
        "# Gallery",
        "",
        "Each picture opens a page with live sliders. It is one file of some megabytes and fetches nothing.",
        "Drag to orbit, scroll to zoom, hold Space to see the original.",
        "",
    ]
    for exhibit in exhibits:
        page = folder / f"{exhibit.name}.html"
        words = ["--title", exhibit.title, "--credit", exhibit.credit]
        with tempfile.TemporaryDirectory() as unpacked:  # a bundle is unpacked into the folder that holds it
            bundle = shutil.copy(exhibit.bundle, unpacked)
            status = progdf(["export", bundle, "-o", str(page), *words])
        if status:
            sys.exit(f"the page of {exhibit.bundle.name} could not be written")
        shutil.copyfile(EXAMPLES / f"{exhibit.name}.jpg", folder / f"{exhibit.name}.jpg")
        size = page.stat().st_size / 1e6
        lines += [
            f"## {exhibit.title}",
            "",
            f"[![{exhibit.title}](gallery/{exhibit.name}.jpg)](gallery/{exhibit.name}.html)",
            "",
            f"{exhibit.text} *{size:.1f} MB. {exhibit.credit}.*",
            "",
        ]
    (folder / "gallery.md").write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    write_gallery(Path(sys.argv[1]))
