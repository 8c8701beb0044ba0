"""Saved state of a run: resuming at any step gives the same bits, and saving takes little time."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest
import torch

from progdf.errors import ProgdfError
from tests.helpers.trained import course, small
from trainer.optimize.pgs import PgsState, optimize
from trainer.store.state import PeriodicSave, Saved, StateFolder


def test_optimizer_resumes_from_any_step_bit_for_bit(tmp_path: Path) -> None:
    case = small("body")
    wanted = course(case, steps=6)
    straight = list(optimize(*wanted))
    original = wanted[0]
    folder = StateFolder(tmp_path / "state")
    folder.begin({})

    class Stop(Exception):  # noqa: N818
        pass

    state = PgsState(original)
    resumed = []
    for _ in range(20):  # stopped after every step and restored into a new state

        def on_step(step: int, left: float) -> None:
            raise Stop

        try:
            resumed.extend(snapshot for snapshot in optimize(*wanted, on_step, state))
            break
        except Stop:
            saved = state.capture_state()
            folder.save("pgs", saved.tensors, saved.values)
            state = PgsState(original, seed=5)
            restored = folder.load("pgs")
            assert restored is not None
            state.restore(restored)
    assert len(resumed) == len(straight)
    for one, other in zip(resumed, straight, strict=True):
        assert torch.equal(one.offsets, other.offsets)
        assert (one.step, one.ends_stage, one.means) == (other.step, other.ends_stage, other.means)


def test_saving_takes_at_most_one_percent_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("trainer.store.state.time.perf_counter", lambda: now)
    folder = StateFolder(tmp_path / "state")
    folder.begin({})

    class Slow:
        def capture_state(self) -> Saved:
            nonlocal now
            now += 0.5  # a save takes 0.5 s
            return Saved({}, {})

        def restore(self, saved: Saved) -> None: ...

    kept = PeriodicSave(folder, "training", {"slow": Slow()}, every_s=10.0)
    for _ in range(4000):
        now += 0.1
        kept.step_done()
        folder.wait()  # the mocked clock does not advance for the writing thread
    assert 0.5 * 0.01 < kept.seconds / now < 1.01 * 0.01


def test_training_continues_while_a_slow_disk_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flushed, rows = threading.Event(), torch.ones(3)
    monkeypatch.setattr("trainer.store.state.flush_to_disk", lambda path: flushed.wait(60.0))
    folder = StateFolder(tmp_path / "state")
    folder.path.mkdir()

    class Rows:
        def capture_state(self) -> Saved:
            return Saved({"rows": rows}, {})

        def restore(self, saved: Saved) -> None: ...

    kept = PeriodicSave(folder, "training", {"rows": Rows()}, every_s=0.001)
    time.sleep(0.002)
    kept.step_done()
    rows += 1.0
    kept.step_done()
    assert kept.saves == 1, "one after the other"
    flushed.set()
    saved = folder.load("training")
    assert saved is not None
    assert saved.tensors["rows/rows"].tolist() == [1.0] * 3, "as it was when it was saved"


def test_linked_state_folder_is_refused_and_left_unchanged(tmp_path: Path) -> None:
    own = tmp_path / "own"
    (own / "run.json").parent.mkdir()
    (own / "run.json").write_text("mine")
    (own / "pictures").mkdir()
    folder = StateFolder(tmp_path / "state")
    folder.path.symlink_to(own)
    with pytest.raises(ProgdfError, match="is a link"):
        folder.begin({})
    folder.end()
    assert sorted(path.name for path in own.iterdir()) == ["pictures", "run.json"]
