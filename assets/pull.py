"""Make the pictures and the film of pulls: parts of several scenes, from four sides, at five strengths.

usage: python assets/pull.py OUT [--scenes FOLDER] [--only NAME] [--size PIXELS]

FOLDER holds playbot_31k.ply with its labels, tarot.splat and plant.ply; pulls of missing scenes are left out.
The demo bear is made here. OUT receives an edit and a sheet for each pull, pulls.jpg with one side of each,
and the film pulls.webp of the scenes that may be shown. The pictures in the repository show PLAYBOT by
Stephane Agullo and a card box by Marcel Padilla, both CC-BY-4.0.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.layers.pull_parts import PULLS, make_bear
from progdf.__main__ import main as progdf
from progdf.errors import ProgdfError
from progdf.io.images import contact_sheet, read_picture, to_picture

AZIMUTHS = (20, 110, 200, 290)
"""Sides, degrees."""
STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)
QUALITY = 86
FILM_SIZE = 360  # pixels
FILM_QUALITY = 60
FILM_FRAME_MS = 60
LOOK = ("--background", "#82a3c2", "--engine", "cpu")


@dataclass(frozen=True)
class Shot:
    """Camera of a pull."""

    elevation: float  # degrees
    distance: float  # from the middle of what moves, world units
    side: int  # index of the side in the picture of all pulls
    is_shown: bool = True  # in the picture and the film of all pulls


SHOTS = {
    "head": Shot(5.0, 1.75, 0),
    "corner": Shot(20.0, 1.1, 0),
    "arm": Shot(8.0, 4.0, 0),
    "nose": Shot(8.0, 2.4, 3),
    "leaf": Shot(8.0, 0.7, 2, is_shown=False),
}


def run(*words: str | Path) -> None:
    """Run one command line of progdf.

    Raises:
        ProgdfError: the command fails.
    """
    if progdf([str(word) for word in words]):
        raise ProgdfError(f"progdf {words[0]} failed")


def view_options(name: str, azimuth: int, size: int) -> tuple[str, ...]:
    """Return the options of `progdf render` for one side of a pull."""
    orbit = f"{azimuth},{SHOTS[name].elevation:g},{SHOTS[name].distance:g}"
    return ("--frame", name, "--orbit", orbit, "--size", f"{size}x{size}", *LOOK)


def draw(folder: Path, scene: Path, name: str, azimuth: int, strength: float, size: int) -> Tensor:
    """Draw one side of a pulled scene. [H,W,3]"""
    out = folder / "picture.png"
    options = ("--set", f"{name}={strength}", *view_options(name, azimuth, size))
    run("render", scene, folder / f"{name}.gdf", "-o", out, *options)
    return read_picture(out)


def draw_film(folder: Path, scene: Path, name: str) -> list[Image.Image]:
    """Return the frames of the slider from 0 to 1 and back."""
    frames = folder / f"{name}_frames"
    shutil.rmtree(frames, ignore_errors=True)
    options = ("--sweep", name, *view_options(name, AZIMUTHS[SHOTS[name].side], FILM_SIZE))
    run("render", scene, folder / f"{name}.gdf", "-o", frames, *options)
    return [Image.open(path).convert("RGB") for path in sorted(frames.glob("*.png"))]


def save_film(path: Path, frames: list[Image.Image]) -> None:
    """Write an endless film."""
    first, *others = frames
    settings = {"duration": FILM_FRAME_MS, "loop": 0, "quality": FILM_QUALITY}
    first.save(path, save_all=True, append_images=others, **settings)


def main() -> int:
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=Path)
    parser.add_argument("--only", choices=sorted(SHOTS))
    parser.add_argument("--size", type=int, default=300)
    options = parser.parse_args()
    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    make_bear(out)
    rows = []
    film: list[Image.Image] = []
    labels = [f"{strength:g}" for strength in STRENGTHS]
    for pull in PULLS:
        folder = out if pull.scene == "bear.ply" else options.scenes
        if folder is None or not (folder / pull.scene).exists() or options.only not in (None, pull.name):
            continue
        scene = folder / pull.scene
        run("edit", scene, *(word.format(folder) for word in pull.options), "-o", out / f"{pull.name}.gdf")
        sides = [[draw(out, scene, pull.name, a, s, options.size) for s in STRENGTHS] for a in AZIMUTHS]
        sheet = contact_sheet(sides, [f"{azimuth}°" for azimuth in AZIMUTHS], labels)
        to_picture(sheet).save(out / f"{pull.name}.jpg", quality=QUALITY)
        if SHOTS[pull.name].is_shown and options.only is None:
            rows.append(sides[SHOTS[pull.name].side])
            film += draw_film(out, scene, pull.name)
    if rows:
        to_picture(contact_sheet(rows, column_labels=labels)).save(out / "pulls.jpg", quality=QUALITY)
        save_film(out / "pulls.webp", film)
    return 0


if __name__ == "__main__":
    sys.exit(main())
