"""Decision of a training command in its folder: start, resume a stopped run, or reuse a finished one."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import llvmlite.binding
import msgspec
import numba
import torch

from progdf.errors import ProgdfError
from progdf.io.atomic import check_regular, disk_full, open_error
from progdf.io.cameras import camera_files
from progdf.io.json_values import convert_json, decode_json, to_json
from progdf.region import Region
from trainer.editors import editor_row
from trainer.editors.pictures import strengths_of
from trainer.options import MAX_THREADS, ReportLevel, TrainOptions, flat_values
from trainer.resolve import count_threads, recorded_options, resolve
from trainer.store.run_folder import ResumableError, RunFolder, begin_log, remove_leftovers

_VERSION = 9  # version of the saved state; 9: the loss of a style has no term for sharpness
# environment variables that select the kernels of numba and of the linear algebra libraries
_SWITCHES = (
    "NUMBA_CPU_FEATURES", "MKL_ENABLE_INSTRUCTIONS", "MKL_CBWR", "OPENBLAS_CORETYPE", "ONEDNN_MAX_CPU_ISA",
)  # fmt: skip
_SOG_SUFFIXES = (".json", ".webp")  # suffixes of the files of an unpacked .sog

DELIVERED = "delivered"
"""Empty part of the saved state of a run whose .gdf is written, while its report is not."""
REGION = "region"
"""Part of the saved state with the region's members and score."""


@dataclass(frozen=True)
class ResumeDecision:
    """Next action in a run folder."""

    # "start" from nothing, "go on" from the saved state; "report": only the report is too short; "nothing":
    # the run is finished
    does: Literal["start", "go on", "report", "nothing"]
    threads: int  # a resumed run keeps the number it began with, as sums depend on it
    notes: tuple[str, ...] = ()  # lines for the log


def load_region(out: Path) -> Region | None:
    """Return the region of a stopped run, so that a resumed run need not read its sources again; None if not
    saved."""
    state = RunFolder(out).state
    saved = state.load(REGION) if state.identity() is not None else None
    if saved is None:
        return None
    with state.restore_part(REGION):
        name = saved.values["name"]
        score = saved.tensors["score"]
        if score.dtype != torch.float32 or score.ndim != 1 or not bool(((score >= 0) & (score <= 1)).all()):
            raise ValueError("the score is invalid")
        if not isinstance(name, str):
            raise TypeError("the name is not a text")
        return Region(name, saved.tensors["members"], score)


def decide_resume(folder: RunFolder, options: TrainOptions, region: Region, count: int) -> ResumeDecision:
    """Decide the next action and prepare the folder for it.

    Args:
        folder: opened and locked
        options: resolved options of the requested run
        region: Gaussians that may change
        count: number of Gaussians in the scene

    Raises:
        ProgdfError: without --resume, a stopped run would be lost; with it, the plan differs from the run's.
    """
    saved = _saved_identity(folder)
    plan = recorded_options(options)
    threads = count_threads(options.threads)
    resume = options.resume
    if resume and saved is None and folder.report.is_file():
        recorded_plan, pictures, level = _finished_run(folder)
        remedy_if_finished = "leave out --resume to train again"
        _check_plan(folder, recorded_plan, plan, remedy_if_finished)
        _check_pictures(folder, pictures, picture_digests(plan), remedy_if_finished)
        levels = get_args(ReportLevel)
        if folder.trajectory.is_file() and levels.index(level) < levels.index(options.report):
            note = (
                f"{folder.root} is finished with the report '{level}'; writing the report '{options.report}'"
            )
            return ResumeDecision("report", threads, (note,))
        return ResumeDecision("nothing", threads)
    remove_leftovers(folder)
    requested = _identity(plan, threads)
    if resume and saved is not None:
        if saved.version != requested.version:
            raise ProgdfError(
                f"{folder.root} was started by another version of progdf; train again in another folder"
            )
        remedy = "give --resume the run's own options, or train again in another folder"
        _check_plan(folder, saved.plan, plan, remedy)
        remedy = "restore it and continue with --resume, or train again in another folder"
        if saved.scene != requested.scene:
            raise ProgdfError(f"the scene has changed since {folder.root} was started; {remedy}")
        if saved.cameras != requested.cameras:
            raise ProgdfError(f"{plan.views.cameras} has changed since {folder.root} was started; {remedy}")
        _check_pictures(folder, saved.pictures, requested.pictures, remedy)
        with folder.state.restore_part(REGION):
            if len(region.score) != count:
                raise ValueError("the region is another scene's")
        notes = []
        if saved.torch != requested.torch:
            notes.append(f"torch was {saved.torch} and is {requested.torch}: the last bits may differ")
        if saved.processor != requested.processor:
            change = f"the processor was {saved.processor} and is {requested.processor}"
            notes.append(f"{change}: the last bits may differ, the quality does not")
        if saved.threads != threads:
            notes.append(f"using {saved.threads} threads as at the start of the run, for the same bits")
        return ResumeDecision("go on", saved.threads, tuple(notes))
    is_delivered = folder.state.has(DELIVERED)
    if saved is not None and not is_delivered and (step := _saved_step(folder)):
        raise ProgdfError(
            f"{folder.root} holds a run that was stopped at step {step} of {saved.plan.optimize.steps}; "
            f"add --resume to continue it, or delete {folder.state.path} to start over"
        )
    begin_log(folder, plan.edit)
    folder.state.begin(to_json(requested))
    folder.state.save(REGION, {"members": region.members, "score": region.score}, {"name": region.name})
    notes = ["nothing to resume was saved yet, so the run starts from the beginning"] if resume else []
    return ResumeDecision("start", threads, tuple(notes))


def find_run(options: TrainOptions) -> Literal["nothing", "stopped", "finished"]:
    """Return the state of the folder for a run with the same options."""
    folder = RunFolder(options.out)
    plan = recorded_options(resolve(options))
    saved = _saved_identity(folder)
    if saved is None and not folder.report.is_file():
        return "nothing"
    try:
        _check_plan(folder, saved.plan if saved else _finished_run(folder)[0], plan, "")
    except ProgdfError:
        return "nothing"
    return "stopped" if saved else "finished"


@contextmanager
def explain_stop(folder: RunFolder) -> Iterator[None]:
    """Convert an error that stops a run to one line with the affected file and the way to resume."""
    try:
        yield
    except KeyboardInterrupt:
        remedy = f"the progress is saved in {folder.root}; repeat the command with --resume to continue"
        if folder.state.has(DELIVERED):
            remedy = (
                f"the edit in {folder.root} is complete, its report is not; repeat the command with --resume "
                "to complete the report"
            )
        raise KeyboardInterrupt(remedy) from None
    except (OSError, ProgdfError) as error:
        full = disk_full(error)
        if full is not None:
            trouble = f"the disk of {_file_of(full) or folder.root} is full; free some space"
        elif isinstance(error, OSError):
            file = _file_of(error) or f"a file of {folder.root}"
            trouble = f"{file} cannot be read or written ({error.strerror or error}); check its permissions"
        else:
            raise
        raise ResumableError(f"{trouble}, then continue with --resume") from error


def _file_of(error: OSError) -> str:
    """Return the file named by a system error; "" if none is named, as after a write to an open file."""
    return os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes, os.PathLike)) else ""


@contextmanager
def check_exists(folder: RunFolder) -> Iterator[None]:
    """Raise a ProgdfError with a clear message if the run's folder was removed during the run."""
    try:
        yield
    except (OSError, ProgdfError) as error:
        if folder.state.path.is_dir():
            raise
        raise ProgdfError(f"{folder.state.path} was removed during the run; train again") from error


class _Identity(msgspec.Struct):
    """Everything that determines a run's result bit for bit, as stored in run.json; files by their hashes."""

    plan: TrainOptions
    scene: str
    cameras: str | None
    threads: Annotated[int, msgspec.Meta(ge=1, le=MAX_THREADS)]
    torch: str
    pictures: dict[str, str]
    processor: str
    version: int = 1  # see `_VERSION`


def _identity(plan: TrainOptions, threads: int) -> _Identity:
    cameras = plan.views.cameras
    return _Identity(
        plan,
        _scene_digest(plan.scene),
        _camera_digest(cameras) if cameras else None,
        threads,
        str(torch.__version__),
        picture_digests(plan),
        processor_kind(),
        _VERSION,
    )


def processor_kind() -> str:
    """Return the kind of processor, as far as the last bits of a result depend on it.

    It consists of the target of numba, the instruction set for which torch and the linear algebra libraries
    choose their kernels, and the environment switches that are set.
    """
    switches = [f"{name}={os.environ[name]}" for name in _SWITCHES if os.environ.get(name)]
    name = numba.config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    return ", ".join([name, torch.backends.cpu.get_cpu_capability(), *switches])


def picture_digests(plan: TrainOptions) -> dict[str, str]:
    """Return the hashes of the changed pictures that a plan names, including those of further strengths."""
    paths = [path for given in plan.views.pictures for path in strengths_of(given).values()]
    if plan.editor.anchor is not None:
        paths.append(plan.editor.anchor)
    if not plan.views.pictures:
        paths += editor_row(plan.editor).files(plan.editor.text)
    return {str(path.resolve()): _digest(path) for path in paths}


def _saved_identity(folder: RunFolder) -> _Identity | None:
    identity = folder.state.identity()
    if identity is None:
        return None
    try:
        return convert_json(identity, _Identity)
    except ValueError as error:
        raise folder.state.damage_error(folder.state.path / "run.json", error) from None


def plan_difference(was: TrainOptions, now: TrainOptions) -> str:
    """Return a description of one differing value, as in "--steps 24, not 40"; "" if none differs.

    The preset comes first, as it explains other differences, then the other options of the command line.
    """
    pairs = zip(flat_values(was), flat_values(now), strict=True)
    compared = ((name, typed, _plain(name, a), _plain(name, b)) for (name, typed, a), (*_, b) in pairs)
    differing = [value for value in compared if value[2] != value[3]]
    if not differing:
        return ""
    name, typed, before, after = min(differing, key=lambda value: (value[0] != "preset", not value[1]))
    option = "--" + name.replace("_", "-") if typed else name.replace("_", " ")
    return f"{option} {_spell_value(before)}, not {_spell_value(after)}"


def _plain(name: str, value: Any) -> Any:
    """Return a value for comparison: absolute paths, and None for a 0 that stands for the default."""
    if name in ("views", "image_size", "stages"):
        value = value or None
    return value.resolve() if isinstance(value, Path) else value


def _spell_value(value: object) -> object:
    return "by default" if value in (None, "") else value


def _check_plan(folder: RunFolder, was: TrainOptions, now: TrainOptions, remedy: str) -> None:
    if difference := plan_difference(was, now):
        raise ProgdfError(f"{folder.root} was started with {difference}; {remedy}")


def _check_pictures(folder: RunFolder, was: Mapping[str, str], now: Mapping[str, str], remedy: str) -> None:
    for path in dict.fromkeys((*was, *now)):
        if was.get(path) != now.get(path):
            raise ProgdfError(f"{path} has changed since {folder.root} was started; {remedy}")


def _finished_run(folder: RunFolder) -> tuple[TrainOptions, dict[str, str], ReportLevel]:
    """Return a finished run's plan, the hashes of its changed pictures, and the extent of its report."""
    try:
        report = decode_json(folder.report.read_bytes())
        pictures = convert_json(report.get("pictures", {}), dict[str, str])
        level: ReportLevel = convert_json(report.get("report", "full"), ReportLevel)  # type: ignore[arg-type]
        return convert_json(report["plan"], TrainOptions), pictures, level
    except (ValueError, KeyError, TypeError) as error:
        raise ProgdfError(f"{folder.report} is damaged; leave out --resume to train again") from error


def _saved_step(folder: RunFolder) -> int:
    """Return the step at which the optimization was last saved; 0: not begun."""
    saved = folder.state.load("training")
    if saved is None:
        return 0
    with folder.state.restore_part("training"):
        return int(saved.values["pgs"]["step"])


def _scene_digest(path: Path) -> str:
    """Return the hash of a scene file. For an unpacked .sog it covers the names and bytes of all files."""
    if not path.is_dir():
        return _digest(path)
    return _joint_digest(file for file in path.iterdir() if file.suffix in _SOG_SUFFIXES)


def _camera_digest(path: Path) -> str:
    """Return the hash of a camera file. For a folder it covers the names and bytes of the files read."""
    files = camera_files(path)
    return _digest(path) if files == (path,) else _joint_digest(files)


def _joint_digest(files: Iterable[Path]) -> str:
    """Return the hash of the names and bytes of several files, in the order of their names."""
    parts = [f"{file.name} {_digest(file)}\n" for file in sorted(files)]
    return hashlib.sha256("".join(parts).encode(errors="surrogateescape")).hexdigest()


def _digest(path: Path) -> str:
    check_regular(path)
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise open_error(path, error) from error
