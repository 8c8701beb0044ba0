"""Draw the picture of color and texture, assets/texture.jpg: edits, and their color and texture apart.

usage: python assets/texture.py -o OUT.jpg [--work FOLDER] [--scene FILE --region REGION --orbit AZ,EL]

Without a scene, the demo bear is made here. The edits are a painter's style, stripes, and a picture of the
demo room as a decal. FOLDER keeps scenes and edits, so that a second run only draws.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))
from progdf.__main__ import main as progdf
from progdf.demo_scenes import bear, room
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.io.images import contact_sheet, read_picture, to_picture

COAT = ("body", "head", "ears", "arms", "legs")
EDITS = {"style": "style:20", "stripes": "stripes:#2a6f9e"}
QUICK = ("--quick", "--threads", "1")
SIZE = ("--size", "360x340")
LOOK = ("--background", "#82a3c2", "--engine", "cpu")
COLUMNS = {
    "original": ("--set", "{}=0"),
    "edit": (),
    "color alone": ("--gain", "{}:texture=0"),
    "texture alone": ("--gain", "{}:color=0"),
    "texture twice": ("--gain", "{}:texture=2", "--overshoot"),
}


def run(*words: str | Path) -> None:
    """Run one command line of progdf.

    Raises:
        ProgdfError: the command fails.
    """
    if progdf([str(word) for word in words]):
        raise ProgdfError(f"progdf {words[0]} failed")


def make_bear(folder: Path) -> Path:
    """Write the demo bear and the rows of its coat; return its file."""
    made = bear(24_000, 0)
    save_ply(folder / "scene.ply", made.gaussians)
    np.save(folder / "region.npy", made.members(*COAT).numpy())
    return folder / "scene.ply"


def draw_photograph(folder: Path) -> Path:
    """Write a picture of the demo room, the decal; return its file."""
    path = folder / "photograph.png"
    if not path.exists():
        save_ply(folder / "room.ply", room(40_000, 0).gaussians)
        run("render", folder / "room.ply", "-o", path, "--size", "320x240", *LOOK)
    return path


def train(folder: Path, scene: Path, region: str, orbit: str, at: str) -> list[str]:
    """Train the edits that do not exist yet; return their names."""
    view = folder / "view.png"
    run("render", scene, "-o", view, "--orbit", orbit, "--size", "640x604", *LOOK)
    decal = f"decal:{draw_photograph(folder)}"
    edits = {
        **{name: (editor, "--region", region) for name, editor in EDITS.items()},
        "decal": (decal, "--region", region, "--camera", str(view), "--at", at),
    }
    for name, (editor, *words) in edits.items():
        if not (folder / f"{name}.gdf").exists():
            out = folder / "runs" / name
            run("train", scene, "--out", out, "--editor", editor, *words, *QUICK)
            (out / f"{name}.gdf").rename(folder / f"{name}.gdf")
    return list(edits)


def draw(folder: Path, scene: Path, name: str, orbit: str, words: tuple[str, ...]) -> Tensor:
    """Draw the scene under one edit. [H,W,3]"""
    options = [word.format(name) for word in words]
    out = folder / "picture.png"
    run("render", scene, folder / f"{name}.gdf", "-o", out, "--orbit", orbit, *SIZE, *LOOK, *options)
    return read_picture(out)


def main() -> int:
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--region", default="all")
    parser.add_argument("--orbit", default="20,12")
    parser.add_argument("--at", default="0.5,0.6,0.3")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.work or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        scene = options.scene
        region = options.region
        if scene is None:
            scene = make_bear(folder)
            region = f"file:{folder}/region.npy"
        names = train(folder, scene, region, options.orbit, options.at)
        rows = [
            [draw(folder, scene, name, options.orbit, words) for words in COLUMNS.values()] for name in names
        ]
        sheet = contact_sheet(rows, notes=[list(COLUMNS)] * len(rows))
        to_picture(sheet).save(options.out, quality=88)
    return 0


if __name__ == "__main__":
    sys.exit(main())
