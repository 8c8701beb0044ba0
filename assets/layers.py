"""Draw the picture of layers, assets/layers.jpg: combinations of color edits.

usage: python assets/layers.py -o OUT.jpg [--work FOLDER]

All inputs are made here: the bear, three edits of its coat, the room and its dusk, a color table. FOLDER
keeps scenes and edits, so that a second run only draws.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))
from progdf.__main__ import main as progdf
from progdf.demo_scenes import bear, room
from progdf.errors import ProgdfError
from progdf.field.baked import lattice_colors
from progdf.formats.cube import SIDE, write_cube
from progdf.formats.ply import save_ply
from progdf.io.cameras import save_cameras
from progdf.io.images import contact_sheet, read_picture, to_picture

COAT = ("body", "head", "ears", "arms", "legs")
EDITS = {"stripes": "stripes:#2a6f9e", "dark": "darken:0.6", "gold": "tint:#e0a030"}
QUICK = ("--views", "12", "--image-size", "192", "--threads", "1")
VIEW = ("--orbit", "20,12", "--size", "400x340", "--background", "#82a3c2", "--engine", "cpu")
COLUMNS = 3
STACKS = {
    "stripes": ("stripes.gdf",),
    "darkened: average": ("stripes.gdf", "dark.gdf", "--blend", "normalized"),
    "darkened: add": ("stripes.gdf", "dark.gdf", "--blend", "sum"),
    "darkened: over": ("stripes.gdf", "dark.gdf", "--blend", "over"),
    "darkened: adjust": ("stripes.gdf", "dark.gdf"),
    "stripes, dark, gold": ("stripes.gdf", "dark.gdf", "gold.gdf"),
    "gold, dark, stripes": ("gold.gdf", "dark.gdf", "stripes.gdf"),
    "the dusk of the room, on the coat": ("dusk.gdf", "--region", "dusk=file:bear.npy"),
    "a .cube file, everywhere": ("teal.cube",),
}


def run(*words: str | Path) -> None:
    """Run one command line of progdf.

    Raises:
        ProgdfError: the command fails.
    """
    if progdf([str(word) for word in words]):
        raise ProgdfError(f"progdf {words[0]} failed")


def train(folder: Path, scene: str, name: str, editor: str) -> None:
    """Train an edit of SCENE.ply in the rows of SCENE.npy, unless it exists."""
    if not (folder / f"{name}.gdf").exists():
        region = f"file:{folder / scene}.npy"
        out = folder / "runs" / name
        words = "--region", region, "--editor", editor, "--cameras", folder / f"{scene}.json", *QUICK
        run("train", folder / f"{scene}.ply", "--out", out, *words)
        (out / f"{name}.gdf").rename(folder / f"{name}.gdf")


def prepare(folder: Path) -> None:
    """Write the scenes, the edits and the color table."""
    for name, made, parts in (("bear", bear(24_000, 0), COAT), ("room", room(12_000, 0), None)):
        save_ply(folder / f"{name}.ply", made.gaussians)
        save_cameras(folder / f"{name}.json", made.cameras, made.gaussians.origin)
        np.save(folder / f"{name}.npy", made.members(*(parts or made.label_names)).numpy())
    for name, editor in EDITS.items():
        train(folder, "bear", name, editor)
    train(folder, "room", "dusk", "tint:#4f6fd8")
    colors = lattice_colors(SIDE)
    light = (colors @ torch.tensor([0.2126, 0.7152, 0.0722]))[:, None]
    teal = torch.lerp(torch.tensor([-0.08, 0.02, 0.1]), torch.tensor([0.08, 0.0, -0.1]), light)
    write_cube(folder / "teal.cube", colors * colors * (3 - 2 * colors) + teal, "teal and orange")


def draw(folder: Path, words: Sequence[str]) -> Tensor:
    """Draw the bear with a stack of layers. [H,W,3]"""
    files = [str(folder / word) if word.endswith((".gdf", ".cube")) else word for word in words]
    stack = [word.replace("file:", f"file:{folder}/") for word in files]
    run("render", folder / "bear.ply", *stack, *VIEW, "-o", folder / "picture.png")
    return read_picture(folder / "picture.png")


def main() -> int:
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--work", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.work or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        prepare(folder)
        pictures = [draw(folder, words) for words in STACKS.values()]
        names = list(STACKS)
        rows = range(0, len(names), COLUMNS)
        sheet = contact_sheet(
            [pictures[i : i + COLUMNS] for i in rows], notes=[names[i : i + COLUMNS] for i in rows]
        )
        to_picture(sheet).save(options.out, quality=88)
    return 0


if __name__ == "__main__":
    sys.exit(main())
