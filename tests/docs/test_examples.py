"""Every command line and every Python block of the README and the documents runs, on small files.

Commands run as they are typed. A test may append options that make a command cheap (`cheap_options`) and
replace words in capitals by names of files (`PLACEHOLDERS`). A command that cannot run here is in `REFUSALS`
or in `DRY_RUNS`, with its reason.
"""

from __future__ import annotations

import contextlib
import glob
import importlib.util
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as benchmarks
from progdf.__main__ import COMMANDS, main, run_guarded
from progdf.camera import Camera
from progdf.field import neural_fit
from tests.helpers.comfy_server import comfy_server
from tests.helpers.documents import Example, command_examples, python_examples
from tests.helpers.image_server import image_server
from tests.helpers.null_app import null_platform
from tests.helpers.paths import ROOT
from tests.helpers.scenes import orbit_camera
from tests.helpers.small_benchmarks import shrink_benchmarks, shrink_demo, shrink_suite
from tests.helpers.stopped_runs import at_step
from tests.helpers.trained import quick_options
from viewer.app.app import App

NO_WEIGHTS = (
    "the weights of the models are not on this machine",
    r"^progdf: the weights of \S+ are not on this machine .*; download them with 'hf download .*'",
)
NO_CLUSTER = (
    "there is no Ray cluster at this address",
    r"^progdf: no Ray cluster answers at HEAD:6379 .*; check the address, or start one with",
)
REFUSALS = {
    "progdf train robot.ply --out runs/batman --region 'text:\"the man\"' "
    "--editor 'instruct:\"turn him into Batman\"'": NO_WEIGHTS,
    "progdf train robot.ply --out runs/marble --region labels:robot_labels.npy:1 "
    "--editor 'instruct:\"turn him into a marble statue\"'": NO_WEIGHTS,
    "progdf batch catalogue.toml --out /shared/runs --address HEAD:6379 --dry-run": NO_CLUSTER,
    "progdf batch catalogue.toml --out /shared/runs --address HEAD:6379": NO_CLUSTER,
}
"""Commands that end with status 2 here: the reason, and a regular expression for their one line."""

DRY_RUNS = {
    "make setup": "installs packages",
    "make demo": "installs packages; the commands of its recipe are documented, and run on their own",
    "make test": "runs this test",
    "make test-cpus": "runs this test",
    "make test-all": "runs this test",
    "make lint": "takes minutes, and runs before every change lands",
    "make bench": "measures for an hour; its benchmarks run small in other tests",
    "make pictures": "overwrites the pictures of the documents",
    "make tables": "overwrites the tables of the documents; the benchmarks run small in other tests",
    "make site": "installs packages; a test of its own builds the site",
    "make packages": "installs packages for minutes",
    "make examples": "trains for minutes; the same edits are trained small in other tests",
}
"""Targets of the Makefile that are only expanded, and why."""

PLACEHOLDERS = {
    "SCENE": "scene.ply",
    "RUN": "runs/blue",
    "REGION": "labels:scene_labels.npy:1",
    "EDITOR": "recolor:#3060d0",
    "FOLDER": "suite",
    "OUT": "out.ply",
    "AZ,EL": "30,15",
    "/shared/runs": "shared/runs",
}
"""Placeholder words of the documents and their values in the tests."""

TRAINING = {"--views": "5", "--image-size": "48", "--steps": "24", "--stages": "2", "--threads": "1"}
"""Options appended to `progdf train` if the command does not give them."""

NEEDS_RUNS = ("progdf fit", "progdf evaluate", "python -m benchmarks edits", "python -m benchmarks ablate")
SLOW = ("progdf train", "progdf demo", "progdf batch", "python", *NEEDS_RUNS)

EXTRAS = {
    "api": "openai",
    "colmap": "pycolmap",
    "formats": "gaussforge",
    "usd": "pxr",
    "video": "imageio_ffmpeg",
    "cluster": "ray",
}
"""Optional parts of the program, and the module that each installs."""


def is_slow(example: Example) -> bool:
    """Return True for a command that takes more than a second or two."""
    return example.text.startswith(SLOW)


def cheap_options(words: list[str]) -> list[str]:
    """Return options that make the command cheap and that it does not give itself."""
    options: dict[str, str] = {}
    switches: list[str] = []
    if words[:2] == ["progdf", "train"]:
        options = dict(TRAINING)
        if "--api-url" in words:
            options["--edit-size"] = "64"
        if "--preset" in words:
            options["--size"] = "tiny"
    if words[:2] == ["progdf", "demo"]:
        options = {"--size": "1500", "--threads": "1"}
        switches = ["--quick", "--no-window"]
    if words[:4] == ["python", "-m", "benchmarks", "window"]:
        options = {"--seconds": "0.5"}
    if words[:4] == ["python", "-m", "benchmarks", "ablate"]:
        options = {"--only": "base,descent", "--threads": "1"}
        switches = ["--quick"]
    if words[:3] == ["python", "-m", "pytest"]:
        switches = ["--collect-only"]
    added = [word for name, value in options.items() if name not in words for word in (name, value)]
    return added + [switch for switch in switches if switch not in words]


def different_examples() -> list[Example]:
    """Return the documented commands, each once if a test would run several with the same words."""
    found: dict[tuple[str, ...], Example] = {}
    for example in command_examples():
        words = [PLACEHOLDERS.get(word, word) for word in example.words]
        if words[:2] == ["progdf", "demo"] and "--size" in words:  # `shrink_demo` has one size
            at = words.index("--size")
            words[at : at + 2] = cheap_options(["progdf", "demo"])[:2]
        found.setdefault(tuple(sorted(words + cheap_options(words))), example)
    return list(found.values())


def _params(examples: list[Example]) -> list[Any]:
    slow = pytest.mark.slow
    return [pytest.param(e, id=e.title, marks=[slow] if is_slow(e) else []) for e in examples]


EXAMPLES = different_examples()
MAKE = [example for example in EXAMPLES if example.words[0] == "make"]
VIEW = [example for example in EXAMPLES if example.words[:2] == ["progdf", "view"]]
WITH_RUNS = [example for example in EXAMPLES if example.text.startswith(NEEDS_RUNS)]
ALONE = [example for example in EXAMPLES if example not in (*MAKE, *VIEW, *WITH_RUNS)]


def typed_words(example: Example) -> list[str]:
    """Return the words as the shell passes them on, with placeholders and patterns replaced."""
    words: list[str] = []
    for word in example.words:
        word = PLACEHOLDERS.get(word, word)
        words += sorted(glob.glob(word)) if "*" in word and glob.glob(word) else [word]
    return words


def clear_outputs(words: list[str]) -> None:
    """Remove the output that the template holds already. A user has none before the command runs."""
    if "--resume" in words or words[1] == "batch":
        return
    for option in ("--out", "-o"):
        if option in words:
            out = Path(words[words.index(option) + 1])
            shutil.rmtree(out, ignore_errors=True) if out.is_dir() else out.unlink(missing_ok=True)


def stop_training(words: list[str]) -> None:
    """Run a command without its `--resume`, and interrupt it as Ctrl-C does after its first step."""
    words = [word for word in words if word != "--resume"]
    clear_outputs(words)
    with pytest.MonkeyPatch.context() as patch:
        at_step(patch, 1, lambda: os.kill(os.getpid(), signal.SIGINT))
        assert main(words[1:]) == 130


def run_words(words: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    """Run a command line in this process; return its exit status."""
    if words[0] == "progdf":
        return main(words[1:])
    assert words[1] == "-m", words
    module = words[2]
    if module == "benchmarks":
        return run_guarded(benchmarks.main, words[3:])
    if module == "pytest":
        command = [sys.executable, *words[1:]]
        return subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode
    monkeypatch.setattr(sys, "argv", [module, *words[3:]])
    runpy.run_module(module, run_name="__main__", alter_sys=True)
    return 0


@contextlib.contextmanager
def with_server(words: list[str]) -> Iterator[list[str]]:
    """Yield the words with a running server instead of the documented one."""
    if "--api-url" not in words:
        yield words
        return
    is_comfy = any(word.startswith("comfy:") for word in words)
    with comfy_server() if is_comfy else image_server() as server:
        at = words.index("--api-url") + 1
        yield [*words[:at], server.url, *words[at + 1 :]]


def check_example(
    example: Example, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Run a documented command in the current folder and check its status and its one line."""
    words = typed_words(example)
    clear_outputs(words)
    words += cheap_options(words)
    if words[:2] == ["progdf", "train"] and "--resume" in words:
        stop_training(words)
    capsys.readouterr()
    monkeypatch.setenv("PATH", str(Path("programs").absolute()), prepend=os.pathsep)
    with with_server(words) as served:
        status = run_words(served, monkeypatch)
    errors = capsys.readouterr().err
    missing = re.search(r"progdf-studio\[(\w+)\]", errors)
    if missing and importlib.util.find_spec(EXTRAS.get(missing[1], "progdf")) is None:
        assert status == 2
        pytest.skip(f"the extra {missing[1]} is not installed")
    if example.text in REFUSALS:
        reason, message = REFUSALS[example.text]
        assert status == 2, f"it runs although {reason}: take it out of REFUSALS"
        assert re.search(message, errors, re.MULTILINE), errors
        return
    assert status == 0, errors


@pytest.mark.parametrize("example", _params(ALONE))
def test_documented_command_runs(
    here: Path, example: Example, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if example.words[0] == "python":
        shrink_benchmarks(monkeypatch)
        monkeypatch.setattr(benchmarks, "ROOT", here)  # `page` writes the documents below ROOT
    if example.words[3:] == ["page"]:  # the other benchmarks do the same in the example with --scenes
        monkeypatch.setattr(benchmarks, "PAGE", benchmarks.PAGE_OF_SCENES)
    if example.words[:2] == ["progdf", "demo"]:
        shrink_demo(monkeypatch)
    check_example(example, monkeypatch, capsys)


@pytest.mark.parametrize("example", _params(WITH_RUNS))
def test_documented_command_on_a_finished_run_runs(
    beside_runs: Path, example: Example, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shrink_benchmarks(monkeypatch)
    steps, *effort = neural_fit.EFFORT["small"]
    monkeypatch.setitem(neural_fit.EFFORT, "small", (steps // 50, *effort))
    check_example(example, monkeypatch, capsys)


@pytest.mark.gl
@pytest.mark.parametrize("example", _params(VIEW))
def test_documented_window_opens(
    here: Path, example: Example, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Open it on glfw's null platform and close it after its first frame."""
    opened: list[App] = []

    def draw_once(app: App) -> None:
        app.draw()
        opened.append(app)

    monkeypatch.setattr(App, "loop", draw_once)
    with null_platform():
        check_example(example, monkeypatch, capsys)
    (app,) = opened
    gdfs = sum(word.endswith(".gdf") for word in typed_words(example))
    assert len(app.documents.get().gdfs) == max(gdfs, "--session" in example.words)


@pytest.mark.parametrize("example", _params(MAKE))
def test_documented_make_target_expands_to_existing_commands(example: Example) -> None:
    assert example.text in DRY_RUNS
    shown = subprocess.run(
        ["make", "--dry-run", *example.words[1:]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert shown.returncode == 0, shown.stderr
    for command in re.findall(r"bin/progdf (\S+)", shown.stdout):
        assert command in COMMANDS


def test_every_exception_is_still_documented() -> None:
    documented = {example.text for example in command_examples()}
    assert {*REFUSALS, *DRY_RUNS} <= documented
    pages = [words[3:5] for words in map(str.split, documented) if words[3:4] == ["page"]]
    assert ["page", "--scenes"] in pages, "the one that runs every benchmark of the page"
    assert set(benchmarks.PAGE_OF_SCENES) < set(benchmarks.PAGE)


@pytest.mark.parametrize(
    "example",
    [
        pytest.param(
            example,
            id=f"{example.document}, {example.heading}",
            marks=[pytest.mark.slow] if re.search("trainer.batch|run_suite", example.text) else [],
        )
        for example in python_examples()
        if example.document
        != "docs/recipes.md"  # tests/docs/test_recipes.py runs these and checks the results
    ],
)
def test_documented_python_block_runs(here: Path, example: Example, monkeypatch: pytest.MonkeyPatch) -> None:
    shrink_suite(monkeypatch)
    camera: Camera = orbit_camera()
    given = {
        "__name__": "example",
        "camera": camera,
        "options": quick_options(here, "blue", steps=24, stages=2),
    }
    exec(compile(example.text, example.document, "exec"), given)
