"""Failures around a run (disk, folder, files, numbers): one-line errors, and saved work resumes."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.field.baked import identity_map
from progdf.io.tensors import read_tensors, write_tensors
from tests.helpers.full_disk import files_up_to, refuse_temporary_files
from tests.helpers.stopped import OUT, small_run
from tests.helpers.stopped_runs import NEVER, at_step, gone_on, saved_step, words
from tests.helpers.trained import quick_options, train
from trainer.optimize import pgs
from trainer.optimize.color_model import Model
from trainer.optimize.pgs import ParameterSnapshot
from trainer.run.training import Recordings
from trainer.store.run_folder import RunFolder, lock_folder
from trainer.store.state import StateFolder

pytest_plugins = ["tests.helpers.stopped_runs"]
pytestmark = pytest.mark.usefixtures("elsewhere")


def test_edited_view_lost_while_training_is_one_line_and_resumes(
    bear_folder: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lose_all() -> None:
        for path in (OUT / "views" / "edited").glob("*.png"):
            path.unlink()

    with monkeypatch.context() as patch:
        at_step(patch, 5, lose_all)
        with pytest.raises(ProgdfError, match=r"\.png is missing; train again, with --resume"):
            train(small_run(bear_folder), quiet=True)
    assert saved_step() == 24
    gone_on(bear_folder, uninterrupted)


@pytest.mark.usefixtures("stopped")
def test_full_disk_is_one_line_and_saved_work_resumes(
    bear_folder: Path,
    uninterrupted: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("trainer.store.state.SAVE_EVERY", 0.0)
    with files_up_to(40_000):  # the pictures fit in, the optimizer's state does not
        assert main(words(bear_folder, "--resume")) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "progdf: the disk of run is full; free some space, then continue with --resume"
    assert saved_step() == 10
    assert not list(OUT.rglob(".*"))
    gone_on(bear_folder, uninterrupted)


@pytest.mark.parametrize("size", [0, 2_000])
def test_disk_full_from_the_start_is_a_one_line_error(
    bear_folder: Path, size: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with files_up_to(size):
        assert main(words(bear_folder)) == 2
    assert "the disk of run is full; " in capsys.readouterr().err.splitlines()[-1]


def test_nonfinite_loss_keeps_the_state_before_it(
    bear_folder: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = 0
    true_sum = pgs.total_loss

    def poisoned(terms: dict[str, torch.Tensor]) -> torch.Tensor:
        nonlocal calls
        calls += 1
        return true_sum(terms) * (float("nan") if calls == 13 else 1.0)

    with monkeypatch.context() as patch:
        patch.setattr(pgs, "total_loss", poisoned)
        patch.setattr("trainer.store.state.SAVE_EVERY", NEVER)
        with pytest.raises(ProgdfError, match="the loss is nan at step 12; the state before it is kept"):
            train(small_run(bear_folder), quiet=True)
    assert saved_step() == 12
    gone_on(bear_folder, uninterrupted)


def test_run_folder_removed_while_training_is_a_one_line_error(
    bear_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trainer.store.state.SAVE_EVERY", 0.0)
    at_step(monkeypatch, 5, lambda: shutil.rmtree(OUT))
    with pytest.raises(ProgdfError, match="run/state was removed during the run; train again"):
        train(small_run(bear_folder), quiet=True)


def test_unwritable_folder_is_a_one_line_error(bear_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    OUT.mkdir()
    refuse_temporary_files(monkeypatch, errno.EROFS)
    with pytest.raises(ProgdfError, match=r"run.log\.txt cannot be written \(Read-only file system\); "):
        train(small_run(bear_folder), quiet=True)
    with pytest.raises(ProgdfError, match=r"/proc/run cannot be written \(.*\); choose a place"):
        train(replace(small_run(bear_folder), out=Path("/proc/run")), quiet=True)


def test_two_runs_in_one_folder_are_refused(bear_folder: Path) -> None:
    OUT.mkdir()
    with lock_folder(RunFolder(OUT)), pytest.raises(ProgdfError, match="being trained by another process; "):
        train(small_run(bear_folder), quiet=True)


@pytest.mark.usefixtures("stopped")
def test_values_of_another_type_are_a_damaged_state(bear_folder: Path) -> None:
    """Sign the changed values as if the run had saved them."""
    path = OUT / "state" / "training.safetensors"
    mapped, metadata = read_tensors(path)
    tensors = {name: tensor.clone() for name, tensor in mapped.items()}
    values = json.loads(metadata["values"])
    values["pgs"]["means"] = {"l1": ["0.5", 1]}
    write_tensors(path, tensors, {"values": json.dumps(values)})
    with pytest.raises(ProgdfError, match=r"training\.safetensors is damaged .*; delete .*state and train"):
        train(replace(small_run(bear_folder), resume=True), quiet=True)


@pytest.mark.parametrize("part", ["run.json", "training.safetensors", "recordings/000001.safetensors"])
@pytest.mark.usefixtures("stopped")
def test_damaged_state_is_a_one_line_error(bear_folder: Path, part: str) -> None:
    path = OUT / "state" / part
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ProgdfError, match=r"is damaged .*; delete .*state and train again"):
        train(replace(small_run(bear_folder), resume=True), quiet=True)


def test_recording_with_a_map_of_another_degree_is_refused(tmp_path: Path) -> None:
    offsets = torch.zeros(3, 12)
    no_mask = torch.zeros(3, 0, 3)
    models = [Model(degree, 1.0, no_mask, None, 0.1, [], 1, 1) for degree in (1, 2)]
    made = ParameterSnapshot(4, True, offsets, {"left": 0.5}, identity_map(1))
    before, after = (Recordings(StateFolder(tmp_path), offsets.shape, model) for model in models)
    before.add(made)
    saved = before.capture_state()
    before.restore(saved)
    with pytest.raises(ValueError, match=r"table is \[4, 3\] float32, expected \[10, 3\] float32"):
        after.restore(saved)


@pytest.mark.parametrize(
    ("editor", "more"),
    [
        ("night", {"guidance": "7.5"}),
        ("style:14", {"model": "timbrooks/instruct-pix2pix"}),
        ("night", {"edit_size": 512}),
        ("instruct:x", {"guidance": "0.5"}),
        ("instruct:x", {"guidance": "7.5,0.5"}),
        ("instruct:x", {"guidance": "7.5,1.5,1"}),
        ("instruct:x", {"guidance": "much"}),
        ("instruct:x", {"edit_steps": 0}),
        ("style:14", {"edit_size": 8}),
        ("pictures:A.png", {"kind": "geometry"}),
    ],
)
def test_option_that_does_not_apply_to_the_editor_is_refused(
    tmp_path: Path, editor: str, more: dict[str, object]
) -> None:
    with pytest.raises(ProgdfError, match=r"; it is for|does not apply to|must be ") as caught:
        train(quick_options(tmp_path, editor=editor, **more), quiet=True)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()
