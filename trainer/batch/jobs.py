"""Jobs of a batch: reading and checking the catalogue, and the expected cost of a run.

A job is an ordinary run: `cd FOLDER; progdf train …` writes the same bytes (`BatchJob.command`).
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from progdf.errors import ProgdfError
from progdf.io.atomic import read_file
from progdf.io.json_values import convert_json, to_json
from progdf.terminal import group_digits
from trainer.options import MAX_STAGES, PRESETS, VIEWS, TrainOptions, apply_preset, flat_values, with_values
from trainer.resolve import BLANK, check_name, resolve

THREADS = 1
"""Default threads of a run: several jobs use the cores better than several threads."""

_MAX_BYTES = 1 << 24  # largest catalogue
MAX_JOBS = 100_000
"""Maximum number of jobs in a catalogue."""

_LIST_OF = {"scenes": "[[scenes]]", "edits": "[[scenes.edits]]"}
_EXCLUDED_OPTIONS = ("out", "resume", "scene", "name")  # a catalogue sets these in other ways


@dataclass(frozen=True)
class BatchJob:
    """One run of a batch."""

    key: str  # SCENE/NAME, used in reports and by --only
    options: TrainOptions  # as typed; `out` is absolute, other paths are relative to `folder`
    folder: Path = Path()  # working directory of the run

    @property
    def command(self) -> str:
        """Equivalent command of this single run, to be run in `folder`."""
        options = self.options
        words = ["progdf", "train", str(self.options.scene)]
        default = apply_preset(BLANK, options.preset)
        usual = {name: value for name, _, value in flat_values(replace(default, preset="default"))}
        for name, typed, value in flat_values(options):
            if typed and value != usual[name] and name != "scene":
                words.append("--" + name.replace("_", "-"))
                words += [] if isinstance(value, bool) else [str(value)]
        return shlex.join(words)


def read_catalogue(path: Path, out: Path) -> tuple[list[BatchJob], list[str]]:
    """Return the jobs of a catalogue and its faults, one line each.

    Args:
        path: TOML; docs/cli.md, batch
        out: folder of the batch; jobs are written to OUT/SCENE/NAME

    Raises:
        ProgdfError: the file cannot be read, or is not TOML.
    """
    try:
        content = read_file(path, _MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise ProgdfError(f"{path} is too large for a catalogue (at most 16 MB)")
        table = tomllib.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise ProgdfError(f"{path} is not a TOML file ({error})") from None
    folder = path.resolve().parent
    jobs = list[BatchJob]()
    faults = list[str]()
    try:
        for key, values in _entries(table):
            try:
                jobs.append(BatchJob(key, make_options(values, out.absolute() / key), folder))
            except ProgdfError as error:
                faults.append(f"{key}: {error}")
    except ProgdfError as error:
        return [], [f"{path}: {error}"]
    counts = Counter(job.key.casefold() for job in jobs)  # some file systems ignore case
    duplicates = dict.fromkeys(job.key for job in jobs if counts[job.key.casefold()] > 1)
    faults += [
        f"{key}: {counts[key.casefold()]} jobs have this name; give scenes or edits a `name`"
        for key in duplicates
    ]
    if not jobs and not faults:
        faults.append(f"{path} holds no edit; add [[scenes]] with a path and [[scenes.edits]]")
    return jobs, faults


def _entries(table: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield key and options of every job, merged from the defaults, the scene, the edit and the sweep."""
    _check_keys(table, ("defaults", "scenes", "sweep"), "the catalogue")
    defaults = _table(table, "defaults")
    sweep = _table(table, "sweep")
    for name, values in sweep.items():
        if not isinstance(values, list) or not values:
            raise ProgdfError(f"[sweep] {name} must be a list of values")
    _check_count(_tables(table, "scenes"), sweep)
    for scene in _tables(table, "scenes"):
        if not isinstance(scene.get("path"), str):
            raise ProgdfError("each of [[scenes]] needs a path")
        path = scene["path"]
        scene_name = check_name(str(scene.get("name", Path(path).stem or path)))
        for edit in _tables(scene, "edits"):
            if not isinstance(edit.get("name"), str):
                raise ProgdfError(f"an edit of {scene_name} has no name")
            own = {k: v for k, v in {**scene, **edit}.items() if k not in ("path", "name", "edits")}
            for values in itertools.product(*sweep.values()):
                point = dict(zip(sweep, values, strict=True))
                suffix = "".join(f",{key}={_file_word(value)}" for key, value in point.items())
                run_name = check_name(edit["name"] + suffix)
                yield f"{scene_name}/{run_name}", {"scene": path, **defaults, **own, **point}


def _check_count(scenes: Sequence[Mapping[str, Any]], sweep: Mapping[str, Sequence[Any]]) -> None:
    """Raise ProgdfError if the catalogue has more than `MAX_JOBS` jobs, before any is built."""
    edits = sum(len(_tables(scene, "edits")) for scene in scenes)
    values = {name: len(points) for name, points in sweep.items()}
    count = edits * math.prod(values.values())
    if count <= MAX_JOBS:
        return
    factors = [f"{group_digits(edits)} edits", *(f"{size} of {name}" for name, size in values.items())]
    raise ProgdfError(
        f"{group_digits(count)} jobs ({' × '.join(factors)}), at most {group_digits(MAX_JOBS)} are allowed; "
        "split the catalogue"
    )


def _table(table: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise ProgdfError(f"[{key}] must be a table")
    return value


def _tables(table: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise ProgdfError(f"{key} must be a list of tables, {_LIST_OF[key]}")
    return value


def _check_keys(table: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    for key in table:
        if key not in known:
            raise ProgdfError(f"{where} has an unknown key '{key}'{_closest(key, known)}")


def _closest(name: str, known: Sequence[str]) -> str:
    match = difflib.get_close_matches(name, known, 1)
    return f"; did you mean '{match[0]}'?" if match else ""


def _file_word(value: object) -> str:
    """Return a swept value as a part of a file name."""
    return re.sub(r"[^\w.#=+@%-]+", "-", str(value)).strip("-")


def make_options(values: Mapping[str, Any], out: Path) -> TrainOptions:
    """Build the options of a run from their command-line names.

    Args:
        values: names with hyphens or underscores; `scene`, `region` and `editor` are required
        out: folder of the run

    Raises:
        ProgdfError: `progdf train` does not accept a name or a value.
    """
    values = {name.replace("-", "_"): value for name, value in values.items()}
    for name in ("region", "editor"):
        if not isinstance(values.get(name), str):
            raise ProgdfError(f"{name} is missing")
    options = replace(BLANK, out=out)
    known = [name for name, typed, _ in flat_values(options) if typed and name not in _EXCLUDED_OPTIONS]
    _check_keys({k: v for k, v in values.items() if k != "scene"}, known, "it")
    preset = values.get("preset", "default")
    if preset != "default":
        if preset not in list(PRESETS):  # a list: values of other types may have no hash
            raise ProgdfError(f"there is no preset {preset!r}")
        options = apply_preset(options, preset)
    options = with_values(options, **{"threads": THREADS, **values})
    try:
        options = convert_json(to_json(options), TrainOptions)
    except ValueError as error:
        raise ProgdfError(re.sub(r"^(\w+\.)?(\w+)", r"\2", str(error))) from None
    resolve(options)
    return options


@dataclass(frozen=True)
class Cost:
    """Expected cost of a run, from a linear fit to measured runs (docs/scale.md)."""

    seconds: float  # on one thread
    memory: int  # peak, bytes
    disk: int  # size of its folder, bytes


def estimate_cost(options: TrainOptions, gaussians: int, members: int) -> Cost:
    """Estimate the cost of a run.

    Args:
        options: as typed
        gaussians: number of Gaussians in the scene
        members: number of Gaussians in the region
    """
    options = resolve(options)
    views = options.views.views or VIEWS
    side = options.views.image_size or 256
    strengths = options.optimize.stages or MAX_STAGES
    pixels = views * side * side
    return Cost(
        seconds=3 + 1.3e-6 * pixels * strengths + 1.7e-4 * members,
        memory=int(500e6 + 300 * gaussians + 4200 * members + 160 * pixels),
        disk=int(1e6 + 1.6 * pixels * (strengths + 3) + 500 * members),
    )
