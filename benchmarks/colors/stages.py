"""The command `python -m benchmarks training-stages`: time and memory of a training by stage.

Each edit is trained in a process of its own for each number of threads. The process writes the processor time
and the peak memory of every stage (`stage_child`). From outside, the benchmark counts its threads that could
run, every 50 ms: a thread that waits for a core counts, so other programs hardly change the share of the work
that is parallel.

    python -m benchmarks training-stages --scene statue.ply --members 180000 --out measured

Finished trainings in the folder are not repeated. `--code` measures another checkout of the project, and
`--before` compares with the folder of an earlier measurement.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from progdf.demo_scenes import bear
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians
from progdf.gdf.file import read_gdf
from progdf.io.atomic import atomic_write
from progdf.io.json_values import decode_json
from progdf.scene.regions import parse_region
from progdf.terminal import group_digits, print_line
from trainer.options import MAX_THREADS, check_ranges

from ..table import BUSY, Table, Wall, busy_share, put_tables, today
from .stage_child import OTHER

Stretch = Mapping[str, Any]
"""One line of `stage_child`."""

ROOT = Path(__file__).parents[2]
CHILD = Path(__file__).with_name("stage_child.py")

OPTIONS: tuple[str, ...] = ()
"""Further options of every `progdf train`."""

QUICK = ("--quick", "--views", "5", "--image-size", "48")
"""Options of the training that compiles the kernels."""
BEAR_GAUSSIANS = 2_000
"""Number of Gaussians of its scene."""

CORES = (2, 4, 8, 16)
"""Numbers of cores for which the wall time is predicted."""

SAMPLE_INTERVAL_S = 0.05  # between two counts of running threads
SMALL_SHARE = 0.01  # of all processor time; smaller stages are added up as "other"


@dataclass(frozen=True)
class StageOptions:
    """Measure the time and the memory of trainings by stage."""

    scene: tuple[Path, ...]
    """Scene files; each is one edit."""
    out: Path
    """Folder for the trainings; finished ones are not repeated."""
    region: tuple[str, ...] = ("all",)
    """Regions as for progdf train: one for all scenes, or one per scene."""
    members: tuple[int, ...] = (0,)
    """Keep the N Gaussians nearest to the region's center (0: all); one number, or one per scene."""
    editor: str = "recolor:#3060d0"
    """Editor as for progdf train."""
    threads: tuple[int, ...] = (1, 2)
    """Numbers of threads; the first is the one of the tables of seconds and memory."""
    code: Path = ROOT
    """Checkout of the project that trains."""
    before: Path | None = None
    """Folder of an earlier measurement, shown beside this one."""
    markdown: tuple[Path, ...] = ()
    """Also put the tables between their markers in these Markdown files."""


@dataclass(frozen=True)
class Edit:
    """One edit to be trained."""

    name: str  # of its folders
    scene: Path
    region: str  # as for `progdf train`
    members: int  # 0: the whole region


@dataclass(frozen=True)
class StageUse:
    """Use of one stage, summed over its repetitions."""

    processor: float  # seconds of all threads, with those of the system
    system: float  # seconds of them in the system
    wall: float  # seconds
    peak_mb: float  # resident memory, MB of 2²⁰ bytes
    parallel: float  # share of the work done while two or more threads could run, 0 to 1


@dataclass(frozen=True)
class Measurement:
    """Figures of one training."""

    stages: Mapping[str, StageUse]  # in order
    held_out: float  # PSNR of the full edit in held-out views, dB
    bytes: int  # size of the .gdf file
    gaussians: int
    members: int

    @property
    def processor(self) -> float:
        """Processor seconds of the training."""
        return sum(use.processor for use in self.stages.values())

    @property
    def system(self) -> float:
        """Processor seconds in the system."""
        return sum(use.system for use in self.stages.values())

    @property
    def wall(self) -> float:
        """Wall seconds of the training."""
        return sum(use.wall for use in self.stages.values())

    @property
    def peak_mb(self) -> float:
        """Peak resident memory, MB."""
        return max(use.peak_mb for use in self.stages.values())

    @property
    def parallel(self) -> float:
        """Share of the processor time that is parallel, 0 to 1."""
        return sum(use.parallel * use.processor for use in self.stages.values()) / self.processor


def measure_stages(options: StageOptions) -> list[Table]:
    """Train the edits, print the tables, and fill the Markdown files.

    Raises:
        ProgdfError: a scene, region or folder does not fit, or a training fails.
    """
    check_stage_options(options)
    for page in options.markdown:
        if not page.is_file():
            raise ProgdfError(f"{page} does not exist; check the name and the folder")
    if not (options.code / "progdf" / "__main__.py").is_file():
        raise ProgdfError(f"{options.code} is no checkout of this project; give the folder that holds progdf")
    edits = list_edits(options)
    if not all(is_finished(folder) for folder in _folders(edits, options)):
        compile_kernels(options)
    busy = busy_share()
    found: dict[Edit, list[Measurement]] = {}
    for edit in edits:
        found[edit] = [train(edit, threads, options) for threads in options.threads]
        print_line(f"{edit.name}: {found[edit][0].processor:.0f} s of processor time")
    before: dict[Edit, Measurement] = {}
    for edit in edits:
        folder = options.out if options.before is None else options.before
        earlier = folder / _folder_name(edit, options.threads[0])
        if options.before is not None and is_finished(earlier):
            before[edit] = read_measurement(earlier)
    tables = [edits_table(found, before), stages_table(found, before, options.threads)]
    tables.append(scaling_table(found, options.threads))
    busy = max(busy, busy_share())
    if busy > BUSY:
        tables = [table.without_wall() for table in tables]
    note = f" Made by `python -m benchmarks training-stages {_words(options)}`; {today()}."
    if busy > BUSY:
        note += " Other processes used the cores, so wall times are omitted."
    tables = [replace(table, note=table.note + note) for table in tables]
    for table in tables:
        print(table.markdown() + "\n", flush=True)
    for page in options.markdown:
        filled = put_tables(page.read_text(encoding="utf-8"), tables)
        with atomic_write(page) as temporary_file:
            temporary_file.write_text(filled, encoding="utf-8")
    return tables


def check_stage_options(options: StageOptions) -> None:
    """Check the lists of numbers.

    Raises:
        ProgdfError: a list is empty, or a number is out of range.
    """
    for name in ("scene", "region", "members", "threads"):
        if not getattr(options, name):
            raise ProgdfError(f"--{name} has no value; give at least one")
    for count in options.members:
        if count < 0:
            raise ProgdfError(f"--members must be 0 (all) or more, got {count}")
    check_ranges(*(("--threads", count, 1, MAX_THREADS) for count in options.threads))


def list_edits(options: StageOptions) -> list[Edit]:
    """Return the edits, one per scene.

    Raises:
        ProgdfError: there are neither one nor as many regions or numbers of members as scenes.
    """
    count = len(options.scene)
    edits = []
    for name, values in (("region", options.region), ("members", options.members)):
        if len(values) not in (1, count):
            raise ProgdfError(f"--{name} has {len(values)} values for {count} scenes; give one, or one each")
    for index, scene in enumerate(options.scene):
        region = options.region[index % len(options.region)]
        members = options.members[index % len(options.members)]
        name = f"{scene.stem}-{members}" if members else scene.stem
        edits.append(Edit(name, scene, region, members))
    if len({edit.name for edit in edits}) < count:
        raise ProgdfError("two scenes have the same name and number of members; measure them one by one")
    return edits


def _folders(edits: Sequence[Edit], options: StageOptions) -> list[Path]:
    """Return the folder of every training."""
    return [options.out / _folder_name(edit, threads) for edit in edits for threads in options.threads]


def compile_kernels(options: StageOptions) -> None:
    """Train a small edit, so that the kernels of the checkout are compiled before anything is measured.

    Raises:
        ProgdfError: the training fails.
    """
    with tempfile.TemporaryDirectory() as name:
        scene = Path(name) / "bear.ply"
        save_ply(scene, bear(BEAR_GAUSSIANS).gaussians)
        small = replace(options, out=Path(name), editor=StageOptions.editor)
        train(Edit("bear", scene, "all", 0), options.threads[-1], small, QUICK)


def nearest_members(scene: Gaussians, members: Tensor, count: int) -> Tensor:
    """Return the members nearest to their median center, sorted. [M] -> [min(M, count)]"""
    centers = scene.means[members].double()
    squares = (centers - centers.median(dim=0).values).square().sum(dim=1)
    order = torch.argsort(squares, stable=True)[:count]
    return members[order].sort().values


def train(edit: Edit, threads: int, options: StageOptions, words: Sequence[str] = ()) -> Measurement:
    """Train an edit unless its folder holds the finished training, and return its figures.

    Args:
        edit: the scene and its region
        threads: number of threads
        options: folder, editor and checkout
        words: further options of `progdf train`

    Raises:
        ProgdfError: the scene or the region does not fit, or the training fails.
    """
    folder = options.out / _folder_name(edit, threads)
    if is_finished(folder):
        return read_measurement(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scene = load_scene(edit.scene)
    members = parse_region(edit.region, scene).members
    region = edit.region
    if edit.members:
        rows = folder / "members.npy"
        np.save(rows, nearest_members(scene, members, edit.members).numpy())
        region = f"file:{rows.resolve()}"
    del scene
    command = [sys.executable, "-P", str(CHILD), "events.jsonl", str(edit.scene.resolve())]
    command += ["--region", region, "--editor", options.editor, "--threads", str(threads)]
    command += [*OPTIONS, *words, "--out", "run"]
    environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, "PYTHONPATH": str(options.code.resolve())}
    (folder / "events.jsonl").unlink(missing_ok=True)
    shutil.rmtree(folder / "run", ignore_errors=True)  # of a training that was stopped
    with (folder / "log.txt").open("w", encoding="utf-8") as log:
        child = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)
        try:
            running = list(count_running(child))
        finally:
            child.kill()  # only if counting was interrupted
            child.wait()
    if child.returncode:
        lines = (folder / "log.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise ProgdfError(f"{edit.name} cannot be trained: {lines[-1] if lines else 'no message'}")
    (folder / "running.json").write_text(json.dumps(running), encoding="utf-8")
    return read_measurement(folder)


def count_running(child: subprocess.Popen[bytes]) -> Iterator[tuple[float, int]]:
    """Yield the time and the number of threads that run or wait for a core, until the process ends."""
    while child.poll() is None:
        yield time.monotonic(), _running_threads(child.pid)
        time.sleep(SAMPLE_INTERVAL_S)


def _running_threads(process: int) -> int:
    """Return the number of a process's threads in the state R; 0 where Linux is missing."""
    count = 0
    for path in Path(f"/proc/{process}/task").glob("*/stat"):
        try:
            line = path.read_text(encoding="ascii", errors="replace")
        except OSError:  # the thread has ended
            continue
        count += line.rpartition(")")[2].split()[0] == "R"
    return count


def is_finished(folder: Path) -> bool:
    """Return True if the folder holds a finished training with its stages."""
    return (folder / "events.jsonl").is_file() and (folder / "run" / "report.json").is_file()


def read_measurement(folder: Path) -> Measurement:
    """Read the figures of a finished training."""
    lines = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
    stretches = [decode_json(line.encode()) for line in lines]
    running = []
    if (folder / "running.json").is_file():
        running = decode_json((folder / "running.json").read_bytes())
    report = decode_json((folder / "run" / "report.json").read_bytes())
    gdf = next(path for path in (folder / "run").glob("*.gdf") if path.name != "draft.gdf")
    edit = read_gdf(gdf)
    return Measurement(
        stages=sum_stages(stretches, running),
        held_out=report["edit"]["psnr_to_views"],
        bytes=gdf.stat().st_size,
        gaussians=edit.scene.count,
        members=edit.members,
    )


def sum_stages(
    stretches: Sequence[Mapping[str, Any]], running: Sequence[Sequence[float]]
) -> dict[str, StageUse]:
    """Add up the stretches of each stage, and all small stages as "other".

    Args:
        stretches: lines of `stage_child`
        running: monotonic time and number of running threads of each sample
    """
    total = sum(line["user"] + line["system"] for line in stretches)
    names = dict.fromkeys(line["stage"] for line in stretches)
    used = dict.fromkeys(names, 0.0)
    for line in stretches:
        used[line["stage"]] += line["user"] + line["system"]
    small = {name for name in names if used[name] < SMALL_SHARE * total or name == OTHER}
    stages = {}
    for name in [*(name for name in names if name not in small), OTHER]:
        parts = [
            line for line in stretches if line["stage"] == name or (name == OTHER and line["stage"] in small)
        ]
        if parts:
            stages[name] = _sum_parts(parts, running)
    return stages


def _sum_parts(parts: Sequence[Stretch], running: Sequence[Sequence[float]]) -> StageUse:
    """Add up stretches of one stage."""
    counts = [n for t, n in running if any(part["begun"] <= t < part["ended"] for part in parts)]
    work = sum(counts)
    return StageUse(
        processor=sum(part["user"] + part["system"] for part in parts),
        system=sum(part["system"] for part in parts),
        wall=sum(part["ended"] - part["begun"] for part in parts),
        peak_mb=max(part["peak_mb"] for part in parts),
        parallel=sum(n for n in counts if n > 1) / work if work else 0.0,
    )


def predicted_wall(parallel: float, cores: int) -> float:
    """Return the wall time on some cores per wall time on one, by Amdahl's law."""
    return 1.0 - parallel + parallel / cores


def edits_table(found: Mapping[Edit, Sequence[Measurement]], before: Mapping[Edit, Measurement]) -> Table:
    """Make a table with one row per edit, measured with the first number of threads."""
    rows = []
    for edit, measured in found.items():
        now = measured[0]
        was = before.get(edit)
        rows.append(
            {
                "edit": edit.scene.stem,
                "members / Gaussians": f"{group_digits(now.members)} / {group_digits(now.gaussians)}",
                "processor, s": _course(was, lambda one: f"{one.processor:.0f}", now),
                "of them in the system": _course(was, lambda one: f"{one.system:.0f}", now),
                "peak memory, GB": _course(was, lambda one: f"{one.peak_mb / 1024:.2f}", now),
                "held out, dB": _course(was, lambda one: f"{one.held_out:.1f}", now),
                "the edit, kB": _course(was, lambda one: f"{one.bytes / 1000:.0f}", now),
            }
        )
    note = (
        "Whole processes, with imports and the report. PSNR of the full edit in views not used for training."
    )
    if before:
        note += " Two figures: before → now."
    return Table.of("training-edits", "Training large regions", rows, note)


def stages_table(
    found: Mapping[Edit, Sequence[Measurement]], before: Mapping[Edit, Measurement], threads: Sequence[int]
) -> Table:
    """Make a table with one row per stage of each edit."""
    rows = []
    for edit, measured in found.items():
        was = before[edit].stages if edit in before else {}
        for name, use in measured[0].stages.items():
            row = {
                "edit": edit.name,
                "stage": name,
                "processor, s": _course(was.get(name), lambda one: f"{one.processor:.1f}", use),
                "of them in the system": _course(was.get(name), lambda one: f"{one.system:.1f}", use),
                "peak memory, GB": _course(was.get(name), lambda one: f"{one.peak_mb / 1024:.2f}", use),
                Wall("wall, s"): f"{use.wall:.1f}",
            }
            for count, other in zip(threads[1:], measured[1:], strict=True):
                second = other.stages.get(name)
                row[f"{count} threads: processor, s"] = "" if second is None else f"{second.processor:.1f}"
                row[f"{count} threads: parallel"] = "" if second is None else f"{100 * second.parallel:.0f} %"
                row[Wall(f"{count} threads: wall, s")] = "" if second is None else f"{second.wall:.1f}"
            rows.append(row)
    note = (
        f"One thread unless said. Stages as in log.txt; other: less than {100 * SMALL_SHARE:.0f} % each. "
        "Memory: the peak while the stage runs, with everything that earlier stages hold. Parallel: share of "
        "the work done while two or more threads could run."
    )
    return Table.of("training-stages", "Training by stage", rows, note)


def scaling_table(found: Mapping[Edit, Sequence[Measurement]], threads: Sequence[int]) -> Table:
    """Make a table with one row per edit: wall time on more cores, measured and predicted."""
    rows = []
    for edit, measured in found.items():
        row = {"edit": edit.name, Wall("wall on 1 thread, s"): f"{measured[0].wall:.0f}"}
        for count, other in zip(threads[1:], measured[1:], strict=True):
            row[Wall(f"{count} threads, measured")] = f"{other.wall / measured[0].wall:.2f}"
        parallel = measured[-1].parallel
        row["parallel"] = f"{100 * parallel:.0f} %"
        row |= {f"{cores} cores": f"{predicted_wall(parallel, cores):.2f}" for cores in CORES}
        rows.append(row)
    note = (
        "Wall time per wall time on one thread. Columns of cores: Amdahl's law from the parallel share of "
        "the last number of threads."
    )
    return Table.of("training-scaling", "Training on more cores", rows, note)


def _course(was: Any, cell: Callable[[Any], str], now: Any) -> str:
    """Return the cell of a measurement, after that of the earlier one if there is one."""
    return cell(now) if was is None else f"{cell(was)} → {cell(now)}"


def _folder_name(edit: Edit, threads: int) -> str:
    return f"{edit.name}-{threads}t"


def _words(options: StageOptions) -> str:
    """Return the options that decide the figures, without folders."""
    words = ["--scene", *(path.name for path in options.scene)]
    words += ["--region", *(_short(region) for region in options.region)]
    if options.members != (0,):
        words += ["--members", *(str(count) for count in options.members)]
    words += ["--editor", options.editor, "--threads", *(str(count) for count in options.threads)]
    if options.before is not None:
        words += ["--before", options.before.name]
    return " ".join(words)


def _short(region: str) -> str:
    """Return a region of labels without the folder of its file."""
    kind, colon, rest = region.partition(":")
    return kind + colon + rest.rpartition("/")[2]
