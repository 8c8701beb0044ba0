"""`progdf demo`: a scene of our own, three trained edits, pictures of what the sliders do, and the window."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from torch import Tensor

from progdf.camera_files import save_cameras
from progdf.checkpoint import Gdf, load_gdf
from progdf.compose import Layer, compose
from progdf.errors import ProgdfError
from progdf.files import written_whole
from progdf.pictures import contact_sheet, write_image
from progdf.ply import load_ply, save_ply
from progdf.rasterize import render
from progdf.scenes import SMALLEST, DemoScene, bear
from trainer.options import TrainOptions

STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)
_GRID = (0.0, 1 / 3, 2 / 3, 1.0)


@dataclass(frozen=True)
class DemoEdit:
    """One edit of the demo: what it is called, which parts it may change, how."""

    name: str
    parts: tuple[str, ...]
    editor: str


_COAT = ("body", "head", "ears", "arms", "legs")
EDITS = {
    "bear": (
        DemoEdit("scarf", ("scarf",), "stripes:#12a150"),
        DemoEdit("gold", _COAT, "recolor:#d89a12"),
        DemoEdit("night", (*_COAT, "scarf"), "night:0.85"),
    )
}
"""Per scene: two edits that share no Gaussian, and one that shares Gaussians with both."""


@dataclass(frozen=True)
class DemoOptions:
    """Make a scene, train three region edits of it, write pictures, open the window if there is a display."""

    scene: Literal["bear"] = "bear"
    """Which scene."""
    size: int = 24_000
    """Number of Gaussians."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo")
    """Folder for the scene, the edits and the pictures; made if need be."""
    quick: bool = False
    """A draft in a third of the time: fewer views and steps."""
    seed: int = 0
    """Of the scene and of the training."""
    threads: int = 0
    """CPU threads; 0 takes all cores but one, at least one."""
    window: bool = True
    """Open the window at the end, where there is a display."""


def main(argv: Sequence[str]) -> int:
    """Run the demo. Raises ProgdfError for options that cannot be met."""
    options = tyro.cli(DemoOptions, args=list(argv), prog="progdf demo")
    if options.size < SMALLEST:
        raise ProgdfError(f"--size is {options.size}; at least {SMALLEST} Gaussians would be right")
    begun = time.perf_counter()
    scene = bear(options.size, options.seed)
    edits = EDITS[options.scene]
    write_scene(options.out, scene)
    print(f"{options.scene}: {options.size:,} Gaussians in {options.out / 'scene.ply'}".replace(",", " "))
    gdfs = {}
    for edit in edits:
        print(f"\n{edit.name}: {edit.editor} on {', '.join(edit.parts)}", flush=True)
        gdfs[edit.name] = load_gdf(_train(options, scene, edit))
    print()
    for picture in write_pictures(options.out, scene, gdfs):
        print(f"look at {picture}")
    command = ["view", str(options.out / "scene.ply"), *(str(_gdf(options.out, edit)) for edit in edits)]
    command += ["--background", _hex(scene.background)]
    print(f"\ndone in {time.perf_counter() - begun:.0f} s; drag the sliders:\n  progdf {shlex.join(command)}")
    if options.window and _has_display():
        # another process, as the trainer and the viewer share nothing but files
        return subprocess.run([sys.executable, "-m", "progdf", *command], check=False).returncode
    return 0


def write_scene(folder: Path, scene: DemoScene) -> None:
    """Write scene.ply, labels.npy ([N] uint8) and cameras.json; the folder is made if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    save_ply(folder / "scene.ply", scene.gaussians)
    with written_whole(folder / "labels.npy") as beside:
        np.save(beside, scene.labels.numpy())
    save_cameras(folder / "cameras.json", scene.cameras)


def write_pictures(folder: Path, scene: DemoScene, gdfs: Mapping[str, Gdf]) -> list[Path]:
    """Write what the sliders do: each alone, two against each other, and before and after in large."""
    gaussians = load_ply(folder / "scene.ply")
    view = scene.cameras[2]

    def shot(size: int, strengths: Mapping[str, float]) -> Tensor:
        layers = [Layer(gdfs[name], strength) for name, strength in strengths.items()]
        with torch.no_grad():
            return render(compose(gaussians, layers), view.resized(size, size), background=scene.background)

    names = list(gdfs)
    labels = [f"{strength:.0%}" for strength in STRENGTHS]
    sliders = contact_sheet(
        [[shot(300, {name: strength}) for strength in STRENGTHS] for name in names],
        [f"{name}" for name in names],
        labels,
        "One slider per edit",
        "  ·  ".join(f"{name}: {gdf.instruction}" for name, gdf in gdfs.items()),
    )
    first, second, *_ = names
    thirds = [f"{strength:.0%}" for strength in _GRID]
    grid = contact_sheet(
        [[shot(260, {first: a, second: b}) for b in _GRID] for a in _GRID],
        [f"{first} {third}" for third in thirds],
        [f"{second} {third}" for third in thirds],
        "Two sliders, every mixture",
    )
    mixtures: list[dict[str, float]] = [{}, dict.fromkeys(names[:2], 1.0), dict.fromkeys(names, 0.7)]
    hero = torch.cat([shot(512, strengths) for strengths in mixtures], dim=1)
    written = []
    for name, image in (("sliders", sliders), ("two-sliders", grid), ("hero", hero)):
        written.append(folder / f"{name}.png")
        write_image(written[-1], image)
    return written


def _train(options: DemoOptions, scene: DemoScene, edit: DemoEdit) -> Path:
    """Train one edit and return its .gdf file."""
    from trainer.run import train  # only now: the pictures above need none of it

    ids = ",".join(str(scene.label_names.index(part)) for part in edit.parts)
    folder = options.out
    train(
        TrainOptions(
            scene=folder / "scene.ply",
            out=folder / edit.name,
            region=f"labels:{folder / 'labels.npy'}:{ids}",
            editor=edit.editor,
            quick=options.quick,
            seed=options.seed,
            threads=options.threads,
        )
    )
    return _gdf(folder, edit)


def _gdf(folder: Path, edit: DemoEdit) -> Path:
    return folder / edit.name / f"{edit.name}.gdf"


def _hex(color: tuple[float, float, float]) -> str:
    return "#" + "".join(f"{round(255 * channel):02x}" for channel in color)


def _has_display() -> bool:
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
