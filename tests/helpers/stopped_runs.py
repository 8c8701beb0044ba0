"""Fixtures of stopped runs, and functions that stop them: keys, a kill."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from progdf.field.trajectory import load_trajectory
from tests.helpers.paths import ROOT
from tests.helpers.stopped import OUT, small_run
from tests.helpers.trained import train, write_bear
from trainer.run import trained
from trainer.store.run_folder import RunFolder
from trainer.store.state import PeriodicSave

NEVER = 1e6  # seconds between saves


@pytest.fixture(scope="session")
def bear_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a small bear."""
    folder = tmp_path_factory.mktemp("bear")
    write_bear(folder)
    return folder


@pytest.fixture(scope="session")
def uninterrupted(bear_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run folder that all others must equal."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        train(small_run(bear_folder), quiet=True)
    return folder / OUT


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Train into `run` of the test's own folder, as the path is stored in the files."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def interrupted(bear_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run folder that was interrupted with Ctrl-C in its tenth step."""
    folder = tmp_path_factory.mktemp("interrupted")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr("trainer.store.state.SAVE_EVERY", NEVER)
        at_step(patch, 9, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(small_run(bear_folder), quiet=True)
    return folder / OUT


@pytest.fixture
def stopped(interrupted: Path, elsewhere: None) -> None:
    """Put a run that was stopped at step 10 into the folder `run`."""
    shutil.copytree(interrupted, OUT)


def at_step(monkeypatch: pytest.MonkeyPatch, number: int, happens: Callable[[], object]) -> None:
    """Call a function after the optimizer has done `number` steps in this process."""
    calls = 0
    done = PeriodicSave.step_done

    def step_done(self: PeriodicSave) -> None:
        nonlocal calls
        calls += 1
        if calls == number:
            happens()
        done(self)

    monkeypatch.setattr(PeriodicSave, "step_done", step_done)


def gone_on(bear_folder: Path, uninterrupted: Path, **more: object) -> str:
    """Resume up to the trajectory, which must equal the uninterrupted run's, and stop. Return the log."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trained, "finish_run", lambda *_: None)
        train(replace(small_run(bear_folder, **more), resume=True), quiet=True)
    found, expected = (_recorded(root / "trajectory.safetensors") for root in (OUT, uninterrupted))
    assert found[0].keys() == expected[0].keys()
    assert all(torch.equal(found[0][name], tensor) for name, tensor in expected[0].items())
    assert more or found[1] == expected[1]  # the options are in the header
    return (OUT / "log.txt").read_text(encoding="utf-8")


def _recorded(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return tensors and header of a trajectory."""
    trajectory, extra, header = load_trajectory(path)
    return {
        **extra,
        "s": trajectory.s,
        "offsets": trajectory.offsets,
        "end": trajectory.end,
        "steps": trajectory.steps,
    }, header


def words(bear_folder: Path, *more: str) -> list[str]:
    """Return the command line of `small_run`."""
    options = small_run(bear_folder)
    values = {
        "region": options.region.region,
        "editor": options.editor.editor,
        "views": options.views.views,
        "image-size": options.views.image_size,
        "steps": options.optimize.steps,
        "stages": options.optimize.stages,
        "perceptual-weight": options.optimize.perceptual_weight,
        "field": options.field.field,
        "threads": options.threads,
    }
    pairs = [f"--{name}={value}" for name, value in values.items()]
    return ["train", str(options.scene), "--out=run", *pairs, *more]


def saved_step() -> int:
    """Return the step of the saved state."""
    saved = RunFolder(OUT).state.load("training")
    assert saved is not None
    return int(saved.values["pgs"]["step"])


def killed(bear_folder: Path, where: Path, moments: Sequence[float], **options: object) -> list[str]:
    """Run `python -m tests.helpers.stopped`. Return its lines."""
    arguments = [str(bear_folder), json.dumps(options), ",".join(map(str, moments))]
    finished = subprocess.run(
        [sys.executable, "-m", "tests.helpers.stopped", *arguments],
        cwd=where,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout.splitlines()
