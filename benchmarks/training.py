"""The benchmark `training`: error of a color edit against the time of its training.

Each run is a separate process. All runs of a scene are compared with the editor's pictures, in views and at
strengths not used for training or choice.

    python -m benchmarks training
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from PIL import Image

from progdf.demo_scenes import bear
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians
from progdf.gdf.file import load_gdf
from progdf.io.atomic import atomic_write
from progdf.scene.regions import parse_region
from trainer.fit.evaluate import Evaluator
from trainer.report.plots import GRID, INK, LINES, PAPER

from .ablation.regret import MEASURED, REPORTING, RegretEdit, begin_edit
from .table import Table, Wall

OPTION_SETS = ("", "--quick", "--steps 40", "--views 12", "--stages 4", "--preset paper --field auto --quick")
"""Options of `progdf train` for each run."""

BEAR = 12_000
"""Number of Gaussians of the bear, whose scarf is striped."""

_MARKERS = "os^DvPX*<>"  # marker of each kind in a plot

STRIPES = "stripes:#20a040"  # for the scarf
BLUE = "recolor:#3060d0"  # for label 1 of a given scene
TINT = "tint:#c08040"  # for the whole of a scene without labels


@dataclass(frozen=True)
class TrainingTask:
    """Scene, region and editor, as arguments of `progdf train`."""

    scene: Path
    region: str
    editor: str


@dataclass(frozen=True)
class TimedEdit:
    """Figures of one run."""

    way: str  # one of `OPTION_SETS`
    seconds: float  # wall time
    processor: float  # processor seconds of all cores together
    psnrs: tuple[float, ...]  # against the editor's pictures at `MEASURED`, dB
    bytes: float  # of the field, per member


def tasks(folder: Path, scenes: Sequence[Path] = ()) -> list[TrainingTask]:
    """Return the tasks of the bear, which is written to a folder, and of each given scene.

    The labels of a given scene are in NAME_labels.npy beside it.
    """
    scene = bear(BEAR)
    labels = folder / "bear_labels.npy"
    save_ply(folder / "bear.ply", scene.gaussians)
    np.save(labels, scene.labels.numpy())
    found = [
        TrainingTask(folder / "bear.ply", f"labels:{labels}:{scene.label_names.index('scarf')}", STRIPES)
    ]
    for path in scenes:
        labels = path.with_name(f"{path.stem}_labels.npy")
        found.append(
            TrainingTask(path, f"labels:{labels}:1", BLUE)
            if labels.is_file()
            else TrainingTask(path, "all", TINT)
        )
    return found


def edit_of_task(task: TrainingTask) -> RegretEdit:
    """Prepare a task's edit, with its views and pictures."""
    scene = load_scene(task.scene)
    region = parse_region(task.region, scene)
    return begin_edit(scene, region, task.editor)


def train(task: TrainingTask, scene: Gaussians, judge: Evaluator, way: str, out: Path) -> TimedEdit:
    """Train a task with the options `way`, and evaluate the written edit.

    Raises:
        ProgdfError: the training fails.
    """
    words = [str(task.scene), "--region", task.region, "--editor", task.editor, "--slider", "stages"]
    command = [sys.executable, "-P", "-m", "progdf", "train", *words, *way.split(), "--out", str(out)]
    began = time.perf_counter()
    before = os.times()
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - began
    after = os.times()
    if run.returncode:
        raise ProgdfError(f"{' '.join(command[3:])}: {run.stderr.strip()}")
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    field = load_gdf(next(out.glob("*.gdf")), scene).field
    psnrs = [judge.psnr(judge.pictures(field.offsets(s)), judge.edited[s]) for s in MEASURED]
    return TimedEdit(way, seconds, spent, tuple(psnrs), field.bytes_per_member)


def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Train each scene with all of `OPTION_SETS`.

    Args:
        scenes: trained in addition to the bear
        plot: also draw the errors over the processor's time into this PNG file
    """
    with tempfile.TemporaryDirectory() as name:
        found: dict[TrainingTask, list[TimedEdit]] = {}
        for task in tasks(Path(name), scenes):
            edit = edit_of_task(task)
            judge = edit.judge()
            outs = (Path(name) / f"{len(found)}-{i}" for i in range(len(OPTION_SETS)))
            found[task] = [
                train(task, edit.scene, judge, *pair) for pair in zip(OPTION_SETS, outs, strict=True)
            ]
    if plot is not None:
        panels = {
            f"{task.scene.stem}, {task.editor}": [
                Point(run.way or "default", run.processor, run.psnrs) for run in runs
            ]
            for task, runs in found.items()
        }
        save_plot(panels, "processor time, s", plot)
    return [table(found)]


def table(found: Mapping[TrainingTask, Sequence[TimedEdit]]) -> Table:
    """Make a table with one row per run."""
    rows = []
    strengths = ", ".join(f"{s:g}" for s in MEASURED[:-1])
    for task, runs in found.items():
        for run in runs:
            between = " ".join(f"{psnr:.1f}" for psnr in run.psnrs[:-1])
            rows.append(
                {
                    "edit": f"{task.scene.stem}, {task.editor}",
                    "`progdf train` with": f"`{run.way}`" if run.way else "(default)",
                    "dB at 1": f"{run.psnrs[-1]:.1f}",
                    "worst between, dB": f"{min(run.psnrs[:-1]):.1f}",
                    f"at {strengths}": between,
                    "processor, s": f"{run.processor:.0f}",
                    Wall("wall, s"): f"{run.seconds:.0f}",
                    "bytes a member": f"{run.bytes:.0f}",
                }
            )
    commands = ", ".join(
        f"`progdf train {task.scene.name} --region {_short(task.region)} --editor {task.editor} "
        "--slider stages --out RUN`"
        for task in found
    )
    note = (
        f"PSNR against the editor's pictures in {REPORTING - 1} rig views not used for training or choice, "
        "over the pixels that show the region. Times are of whole processes, with imports and the report's "
        f"pictures. Each row adds its options to: {commands}."
    )
    return Table.of("training", "Training: error over time", rows, note)


@dataclass(frozen=True)
class Point:
    """One measurement in a plot."""

    kind: str  # name in the legend
    x: float  # ≥ 0
    psnrs: Sequence[float]  # at `MEASURED`, dB
    chosen: bool = False


def save_plot(panels: Mapping[str, Sequence[Point]], across: str, path: Path) -> None:
    """Draw panels side by side in one small PNG file.

    Each point marks the PSNR at strength 1; a line leads to the worst PSNR at the other strengths.
    """
    kinds = list(dict.fromkeys(point.kind for points in panels.values() for point in points))
    drawing = Drawing((3.8 * len(panels), 3.6), 100, facecolor=_shade(PAPER), layout="constrained")
    for axes, (title, points) in zip(
        drawing.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        axes.set_facecolor(_shade(PAPER))
        axes.set_title(title, loc="left", fontsize=9)
        axes.set_xlabel(across, fontsize=8)
        axes.set_ylabel("dB at 1; the stroke: worst between", fontsize=8)
        axes.tick_params(labelsize=8, length=0)
        axes.grid(color=_shade(GRID))
        axes.spines[:].set_visible(False)
        max_x = max(point.x for point in points)
        axes.set_xlim(-0.03 * max_x, 1.08 * max_x)
        if min(point.x for point in points) == 0.0:  # bytes, from 0 to a few hundred
            axes.set_xscale("symlog", linthresh=1.0)
            axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
            axes.set_xlim(-0.2, 1.5 * max_x)
        for point in points:
            index = kinds.index(point.kind)
            color = _shade(LINES[index % len(LINES)])
            mark = _MARKERS[index % len(_MARKERS)]
            axes.plot([point.x] * 2, [point.psnrs[-1], min(point.psnrs[:-1])], color=color, linewidth=1)
            axes.plot(point.x, point.psnrs[-1], mark, color=color, markersize=5, zorder=3)
            if point.chosen:
                axes.plot(point.x, point.psnrs[-1], "o", mfc="none", mec=_shade(INK), markersize=11)
    handles = []
    for index, kind in enumerate(kinds):
        color = _shade(LINES[index % len(LINES)])
        mark = _MARKERS[index % len(_MARKERS)]
        handles.append(Line2D([], [], color=color, marker=mark, linewidth=0, label=kind))
    if any(point.chosen for points in panels.values() for point in points):
        handles.append(Line2D([], [], mfc="none", mec=_shade(INK), marker="o", linewidth=0, label="chosen"))
    drawing.legend(
        handles=handles, loc="outside lower left", fontsize=7.5, ncols=2 * len(panels), frameon=False
    )
    canvas = FigureCanvasAgg(drawing)
    canvas.draw()
    page = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    with atomic_write(path) as temporary_file:
        page.quantize(64, dither=Image.Dither.NONE).save(temporary_file, format="PNG", optimize=True)


def _shade(color: tuple[int, int, int]) -> tuple[float, ...]:
    return tuple(channel / 255 for channel in color)


def _short(region: str) -> str:
    """Return a region's labels without their folder."""
    kind, colon, rest = region.partition(":")
    return kind + colon + rest.rpartition("/")[2]
