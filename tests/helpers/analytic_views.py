"""Edited views with a known truth: an analytic edit of a scene, drawn from the views of a training run.

    python -m tests.helpers.analytic_views ears|tilted|hands OUT [--strengths 0.25,0.5,1] [--size N] [--quick]

writes OUT/scene.ply, OUT/labels.npy, OUT/edited/*.png (and OUT/edited/0.25/*.png …), and prints the command
that trains from them: a `folder:` edit as any other tool would leave it, with a known answer.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import Gaussians
from progdf.io.images import write_image
from progdf.rasterize import render
from progdf.scene.regions import parse_region
from tests.helpers.demo_scenes import bear
from trainer.evaluate.suite.analytic_edits import AnalyticEdit, bear_edits, scale_edit
from trainer.options import EditorOptions, OptimizeOptions, RegionOptions, TrainOptions
from trainer.resolve import resolve
from trainer.views.setup import make_training_setup

PLAYBOT = Path("playbot_31k.ply")  # in the current folder, as in docs/benchmarks.md
_EARS = "big ears"
_HANDS = (2, 3)


@dataclass(frozen=True)
class Truth:
    """A scene and the exact edit of it.

    Args:
        scene: the original
        labels: part of each Gaussian. [N] uint8
        parts: the labels that the edit changes
        edit: the change
    """

    scene: Gaussians
    labels: np.ndarray
    parts: tuple[int, ...]
    edit: AnalyticEdit


def bear_truth(name: str = _EARS, size: int = 6000) -> Truth:
    """Return a bear with edited ears; `name` is "big ears" or "tilted ears"."""
    demo = bear(size)
    edit, members = bear_edits(demo)[name]
    labels = demo.labels.numpy()
    return Truth(demo.gaussians, labels, tuple(int(x) for x in np.unique(labels[members.numpy()])), edit)


def hands_truth(path: Path = PLAYBOT, factor: float = 1.35, lift: float = 0.12) -> Truth:
    """Return the toy robot with both hands enlarged and lifted by `lift` world units (its y axis is down)."""
    scene = load_ply(path)
    labels = np.load(path.with_name(f"{path.stem}_labels.npy"))
    centers = [scene.means[torch.from_numpy(labels == hand)].mean(dim=0) for hand in _HANDS]
    return Truth(
        scene, labels, _HANDS, scale_edit(factor, torch.stack(centers), torch.tensor([0.0, -lift, 0.0]))
    )


def write_truth(folder: Path, truth: Truth) -> tuple[Path, str]:
    """Write scene.ply and labels.npy. Return the scene's path and the region to train."""
    folder.mkdir(parents=True, exist_ok=True)
    save_ply(folder / "scene.ply", truth.scene)
    np.save(folder / "labels.npy", truth.labels)
    return folder / "scene.ply", f"labels:{folder / 'labels.npy'}:{','.join(str(p) for p in truth.parts)}"


def write_analytic_views(
    folder: Path, truth: Truth, options: TrainOptions, strengths: Sequence[float]
) -> None:
    """Draw the edit in every view that a run with these options will have.

    Args:
        folder: folder of the pictures of strength 1; other strengths go into subfolders
        truth: the scene and its edit
        options: the options of `train`, of which those that determine the views matter
        strengths: ascending, the last 1
    """
    options = resolve(options)
    region = parse_region(options.region.region, truth.scene, options.name)
    stand = make_training_setup(options.views, truth.scene, region)
    for strength in strengths:
        where = folder if strength == 1.0 else folder / f"{strength:g}"
        edited = truth.edit.apply(truth.scene, region.members, strength)
        for view in (*stand.train, *stand.held_out):
            with torch.no_grad():
                image = render(edited, view.camera, stand.background).image
            write_image(where / f"{view.camera.name}.png", image)


@dataclass(frozen=True)
class Options:
    """Make a scene and edited views of it with a known truth."""

    what: tyro.conf.Positional[Literal["ears", "tilted", "hands"]]
    """The bear's ears grown 1.7 times or tilted, or the hands of playbot_31k.ply enlarged and lifted."""
    out: tyro.conf.Positional[Path]
    """Output folder."""
    strengths: str = "1"
    """Strengths to draw, such as 0.25,0.5,0.75,1."""
    size: int = 24_000
    """Number of Gaussians of the bear."""
    quick: bool = False
    """Draw the views of a --quick run."""


def main() -> None:
    """Write the folder and print the command."""
    options = tyro.cli(Options)
    truth = (
        hands_truth()
        if options.what == "hands"
        else bear_truth(_EARS if options.what == "ears" else "tilted ears", options.size)
    )
    scene, region = write_truth(options.out, truth)
    edited = options.out / "edited"
    run = TrainOptions(
        scene,
        options.out / options.what,
        RegionOptions(region),
        EditorOptions(f"folder:{edited}"),
        optimize=OptimizeOptions(kind="geometry"),
        quick=options.quick,
    )
    write_analytic_views(edited, truth, run, [float(s) for s in options.strengths.split(",")])
    words = ["train", str(scene), "--out", str(run.out), "--region", region, "--editor", run.editor.editor]
    print("progdf", shlex.join([*words, "--kind", "geometry", *(["--quick"] if options.quick else [])]))


if __name__ == "__main__":
    main()
