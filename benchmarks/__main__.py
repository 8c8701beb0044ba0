"""The command `python -m benchmarks`: run the benchmarks and print their tables, each speed beside its error.

`python -m benchmarks ablate RUN …` trains finished runs again without each part of the method. `python -m
benchmarks page` fills docs/speed-and-error.md. Wall times are left out if other processes use the cores.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from progdf.__main__ import run_guarded
from progdf.cli.options import parse_options
from progdf.errors import ProgdfError
from progdf.formats.scene_file import load_scene
from progdf.io.atomic import atomic_write

from .table import BUSY, Table, busy_share, machine, put_tables, today

COMMAND = "python -m benchmarks"

BENCHES: dict[str, str] = {
    "training": "benchmarks.training:tables",
    "rasterize": "benchmarks.rasterizer:tables",
    "warp": "benchmarks.rasterizer:warp_tables",
    "hard": "benchmarks.rasterizer:hard_tables",
    "field": "benchmarks.field:tables",
    "order": "benchmarks.layers.paint_order:tables",
    "gains": "benchmarks.layers.gains:tables",
    "pull-stages": "benchmarks.layers.pull_stages:tables",
    "pull-parts": "benchmarks.layers.pull_parts:tables",
    "edits": "benchmarks.edits:tables",
    "sliders": "benchmarks.sliders:tables",
    "networks": "benchmarks.networks:tables",
    "viewer": "benchmarks.viewer.slider:tables",
    "select": "benchmarks.viewer.selection:tables",
    "subject": "benchmarks.viewer.subject:tables",
    "frames": "benchmarks.viewer.frames:tables",
    "moving": "benchmarks.viewer.moving:tables",
    "popping": "benchmarks.viewer.popping:tables",
    "painting": "benchmarks.viewer.painting:tables",
    "pull-response": "benchmarks.viewer.pull_response:tables",
    "window": "benchmarks.viewer.window:tables",
    "warps": "benchmarks.motion.warps:tables",
    "trained-motion": "benchmarks.motion.trained_motion:tables",
    "pictures": "benchmarks.pictures:tables",
    "spill": "benchmarks.spill:tables",
    "recolors": "benchmarks.colors.recolors:tables",
    "packing": "benchmarks.colors.packing:tables",
    "grading": "benchmarks.colors.grading:tables",
    "exports": "benchmarks.files.exports:tables",
    "ideal-editors": "benchmarks.editors.ideal_editors:tables",
}

PAGE = (
    *("training", "field", "packing", "order", "gains", "pull-stages", "viewer", "rasterize"),
    *("warp", "moving", "popping", "painting", "grading", "pull-response", "frames", "exports", "hard"),
)
"""Benchmarks of docs/speed-and-error.md."""

PAGE_OF_SCENES = ("training", "field", "exports")
"""Those of `PAGE` that measure the files of --scenes too."""

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class BenchOptions:
    """Measure speed against error; each benchmark interleaves its contenders in one process."""

    what: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Benchmarks to run by name (docs/benchmarks.md); page for docs/speed-and-error.md; none for all."""
    json: Path | None = None
    """Also write the tables to this JSON file."""
    markdown: tuple[Path, ...] = ()
    """Also put the tables between their markers in these Markdown files."""
    runs: tuple[Path, ...] = ()
    """Finished run folders for `edits` and `networks`; for `sliders` the folder of the suite."""
    plots: Path | None = None
    """Folder for the pictures of `training`, `field` and `subject` (.png) and `recolors` (.jpg)."""
    scenes: tuple[Path, ...] = ()
    """Scene files to measure, in place of the demo scenes or beside them (docs/benchmarks.md)."""
    seconds: float | None = None
    """Seconds for which `window` drags its slider (default 60)."""


def main(argv: Sequence[str]) -> int:
    """Run the named benchmarks, the ablation, the sweep or the stages.

    Raises:
        ProgdfError: a name, file or folder does not exist, or an option does not fit the named benchmarks.
    """
    if list(argv[:1]) == ["ablate"]:
        return ablate(argv[1:])
    if list(argv[:1]) == ["regret"]:
        return regret(argv[1:])
    if list(argv[:1]) == ["training-stages"]:
        return training_stages(argv[1:])
    options = parse_options(BenchOptions, argv, COMMAND)
    if options.what == ("page",):
        written = ["--markdown", str(ROOT / "docs/speed-and-error.md"), "--plots", str(ROOT / "assets")]
        return main([*PAGE, *argv[1:], *written])
    for name in options.what:
        if name not in BENCHES:
            raise ProgdfError(
                f"unknown benchmark '{name}'; use one of "
                f"{', '.join((*BENCHES, 'page', 'ablate', 'regret', 'training-stages'))}"
            )
    charted = ("training", "field")
    plotted = (*charted, "recolors", "subject")
    if options.plots and options.what and not set(plotted) & set(options.what):
        raise ProgdfError(f"--plots are for {', '.join(plotted)}; use python -m benchmarks {plotted[0]}")
    trained = ("edits", "networks", "sliders")
    if options.runs and options.what and not set(trained) & set(options.what):
        raise ProgdfError(f"--runs are for {', '.join(trained)}; use python -m benchmarks {trained[0]}")
    drawing = (
        *charted,
        "viewer",
        "select",
        "frames",
        "moving",
        "popping",
        "painting",
        "grading",
        "pull-response",
        "window",
        "warps",
        "trained-motion",
        "pull-parts",
        "pictures",
        "spill",
        "recolors",
        "subject",
        "exports",
    )
    if options.scenes and options.what and not set(drawing) & set(options.what):
        raise ProgdfError(f"--scenes are for {', '.join(drawing)}; use python -m benchmarks viewer")
    if options.seconds is not None and options.what and "window" not in options.what:
        raise ProgdfError("--seconds is the duration of the drag; use python -m benchmarks window")
    # checked before an hour of measuring
    for folder in (options.json and options.json.parent, options.plots):
        if folder is not None and not folder.is_dir():
            raise ProgdfError(f"the folder {folder} does not exist; create it first")
    for path in options.scenes:
        load_scene(path)
    for page in options.markdown:
        if not page.is_file():
            raise ProgdfError(f"{page} does not exist; check the name and the folder")
    arguments: dict[str, dict[str, object]] = {name: {"runs": options.runs} for name in trained}
    with_scenes = PAGE_OF_SCENES if options.what[: len(PAGE)] == PAGE else drawing
    arguments |= {name: {"scenes": options.scenes} for name in with_scenes}
    if options.plots:
        for name in plotted:
            arguments.setdefault(name, {})["plot"] = options.plots / f"{name}.png"
    if options.seconds is not None:
        arguments["window"]["seconds"] = options.seconds
    tables: list[Table] = []
    print(f"{machine()}\n")
    busy = busy_share()
    for name in options.what or tuple(BENCHES):
        try:
            unstated = _function(BENCHES[name])(**arguments.get(name, {}))
        except ProgdfError as error:
            if options.what:
                raise
            print(f"{name} is not measured: {error}\n", file=sys.stderr)
            continue
        before = busy
        busy = busy_share()
        scenes = [options.scenes] if options.scenes and name in with_scenes else []
        words = " ".join([name, *(f"--scenes {' '.join(path.name for path in paths)}" for paths in scenes)])
        finished = [_stated(table, f"`{COMMAND} {words}`", max(before, busy)) for table in unstated]
        for table in finished:
            print(table.markdown() + "\n", flush=True)
        tables += finished
        # the pages are filled after every benchmark, because the next one may take long
        for page in options.markdown if finished else ():
            filled = put_tables(page.read_text(encoding="utf-8"), finished)
            with atomic_write(page) as temporary_file:
                temporary_file.write_text(filled, encoding="utf-8")
    if options.json:
        measured = {"machine": machine(), "tables": [asdict(table) for table in tables]}
        with atomic_write(options.json) as temporary_file:
            temporary_file.write_text(
                json.dumps(measured, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
            )
    return 0


def _stated(table: Table, command: str, busy: float) -> Table:
    """Return the table with its command and date; drop wall times if other processes used the cores."""
    bare = table.without_wall()
    if busy > BUSY and bare != table:
        table = bare
        share = f"{100 * busy:.0f} %"
        command += (
            f"; other processes used {share} of the cores, so wall times and derived values are omitted"
        )
    return replace(table, note=f"{table.note} Made by {command}; {today()}.".strip())


def _function(path: str) -> Callable[..., Any]:
    """Return the function named by "module:name"; each benchmark is imported only when it runs."""
    module, function = path.split(":")
    found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return found


def ablate(argv: Sequence[str]) -> int:
    """Run the ablation and return 0. Raises ProgdfError for errors that the user can fix."""
    from .ablation.ablate import ablate as run
    from .ablation.options import AblateOptions
    from .ablation.table import print_table

    for ablation in run(parse_options(AblateOptions, argv, f"{COMMAND} ablate")):
        print_table(ablation)
    return 0


def regret(argv: Sequence[str]) -> int:
    """Sweep an edit's effort and return 0. Raises ProgdfError for errors that the user can fix."""
    from .ablation.regret import RegretOptions, run_regret

    print(run_regret(parse_options(RegretOptions, argv, f"{COMMAND} regret")).markdown())
    return 0


def training_stages(argv: Sequence[str]) -> int:
    """Measure trainings by stage and return 0. Raises ProgdfError for errors that the user can fix."""
    from .colors.stages import StageOptions, measure_stages

    measure_stages(parse_options(StageOptions, argv, f"{COMMAND} training-stages"))
    return 0


if __name__ == "__main__":
    raise SystemExit(run_guarded(main, sys.argv[1:]))
