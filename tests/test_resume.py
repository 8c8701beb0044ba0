"""A run that is stopped, however and whenever, goes on to the same bits, and says in one line how."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import trainer.pgs
import trainer.run
import trainer.training
from progdf.__main__ import main
from progdf.errors import ProgdfError
from tests.stopped import OUT, bits, small_run
from tests.test_pgs import course
from tests.trained import small, write_bear
from trainer.artefacts import RunFolder, locked
from trainer.descent import PgsState
from trainer.pgs import optimise
from trainer.resume import found
from trainer.run import train
from trainer.state import Autosave, Saved, StateFolder

NEVER = 1e6  # seconds between saves


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small bear."""
    made = tmp_path_factory.mktemp("bear")
    write_bear(made)
    return made


@pytest.fixture(scope="module")
def uninterrupted(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder that all others must equal."""
    made = tmp_path_factory.mktemp("uninterrupted")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        train(small_run(scene), quiet=True)
    return made / OUT


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test trains into `run` of its own folder: the path stands in the files."""
    monkeypatch.chdir(tmp_path)


def at_step(monkeypatch: pytest.MonkeyPatch, number: int, happens: Callable[[], object]) -> None:
    """Let something happen when the optimiser has done so many steps in this process."""
    calls, done = 0, Autosave.step_done

    def step_done(self: Autosave) -> None:
        nonlocal calls
        calls += 1
        if calls == number:
            happens()
        done(self)

    monkeypatch.setattr(Autosave, "step_done", step_done)


@pytest.fixture(scope="module")
def interrupted(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder that was left with Ctrl-C in its tenth step."""
    made = tmp_path_factory.mktemp("interrupted")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        at_step(patch, 9, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(small_run(scene, save_every=NEVER), quiet=True)
    return made / OUT


@pytest.fixture
def stopped(interrupted: Path, _elsewhere: None) -> None:
    """The folder `run` holds a run that was stopped at step 10."""
    shutil.copytree(interrupted, OUT)


def gone_on(scene: Path, uninterrupted: Path, **more: object) -> str:
    """Go on to the trajectory, which must be the uninterrupted run's, and no further; the log."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer.run, "finished", lambda *_: None)
        train(replace(small_run(scene, **more), resume=True), quiet=True)
    found, expected = (root / "trajectory.safetensors" for root in (OUT, uninterrupted))
    if more:  # the options stand in the header
        assert load_file(found).keys() == load_file(expected).keys()
        assert all(torch.equal(load_file(found)[k], tensor) for k, tensor in load_file(expected).items())
    else:
        assert found.read_bytes() == expected.read_bytes()
    return (OUT / "log.txt").read_text(encoding="utf-8")


def words(scene: Path, *more: str) -> list[str]:
    """The command line of `small_run`."""
    options = small_run(scene)
    names = ("region", "editor", "views", "image_size", "steps", "stages", "field", "threads")
    pairs = [f"--{name.replace('_', '-')}={getattr(options, name)}" for name in names]
    return ["train", str(options.scene), "--out=run", *pairs, *more]


def saved_step() -> int:
    """How far the saved state is."""
    saved = RunFolder(OUT).state.load("training")
    assert saved is not None
    return int(saved.values["pgs"]["step"])


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """No file may grow beyond so many bytes: the system refuses, as it does where a disk is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def killed(scene: Path, where: Path, moments: Sequence[float], **options: object) -> list[str]:
    """`python -m tests.stopped`; its lines."""
    arguments = [str(scene), json.dumps(options), ",".join(map(str, moments))]
    told = subprocess.run(
        [sys.executable, "-m", "tests.stopped", *arguments],
        cwd=where,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert told.returncode == 0, told.stdout + told.stderr
    return told.stdout.splitlines()


def test_a_run_killed_wherever_it_writes_goes_on_to_the_same_bits(
    scene: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    draw = random.Random(7)
    # among the views, among the edited ones, twice in the optimisation, at the end
    spans = ((2, 12), (14, 26), (19, 40), (30, 50), (9, 30))
    lines = killed(scene, tmp_path, [float(draw.randint(*span)) for span in spans], save_every=0)
    assert sum(line.endswith("-9") for line in lines) >= 4, lines
    assert bits(tmp_path / OUT) == bits(uninterrupted)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"save_every": 0.2},
        {"save_every": 0, "kind": "geometry", "group_steps": 12},
        {"save_every": 0, "field": "neural", "fit": "alongside", "size": "tiny", "quick": True},
    ],
    ids=["colour", "parts", "alongside"],
)
def test_runs_killed_at_sixteen_moments_go_on_to_the_same_bits(
    scene: Path, tmp_path: Path, options: dict[str, object]
) -> None:
    killed(scene, tmp_path, [], **options)
    expected = bits(tmp_path / OUT)
    shutil.rmtree(tmp_path / OUT)
    draw = random.Random(11)
    moments = [draw.choice((float(draw.randint(1, 60)), draw.uniform(0.2, 4.0))) for _ in range(16)]
    killed(scene, tmp_path, moments, **options)
    assert bits(tmp_path / OUT) == expected


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_saves_the_state_exits_130_and_tells_how_to_go_on(
    scene: Path,
    uninterrupted: Path,
    number: signal.Signals,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    at_step(monkeypatch, 9, lambda: os.kill(os.getpid(), number))
    assert main(words(scene, f"--save-every={NEVER}")) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("progdf: interrupted; ")
    assert last.endswith("give the same command with --resume to go on")
    assert saved_step() == 10
    assert "going on at step 10 of 24" in gone_on(scene, uninterrupted)


def test_ctrl_c_before_the_optimisation_is_kept_too(
    scene: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(trainer.run, "edited_views", lambda *_: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt, match="--resume"):
            train(small_run(scene), quiet=True)
    gone_on(scene, uninterrupted)


@pytest.mark.usefixtures("stopped")
def test_resuming_with_another_option_names_it_and_touches_nothing(scene: Path) -> None:
    before = {path: path.read_bytes() for path in OUT.rglob("*") if path.is_file()}
    with pytest.raises(ProgdfError, match="begun with --steps 24, not 40; "):
        train(replace(small_run(scene, steps=40), resume=True), quiet=True)
    assert {path: path.read_bytes() for path in OUT.rglob("*") if path.is_file()} == before


@pytest.mark.usefixtures("stopped")
def test_resuming_with_another_scene_under_the_same_name_is_refused(scene: Path) -> None:
    about = OUT / "state" / "run.json"
    told = json.loads(about.read_text(encoding="utf-8"))
    about.write_text(json.dumps({**told, "scene": "another"}), encoding="utf-8")
    with pytest.raises(ProgdfError, match="the scene is no longer what run was begun with; "):
        train(replace(small_run(scene), resume=True), quiet=True)


@pytest.mark.usefixtures("stopped")
def test_a_resumed_run_keeps_to_the_threads_it_began_with(scene: Path, uninterrupted: Path) -> None:
    assert "1 threads, as the run began with" in gone_on(scene, uninterrupted, threads=2)
    assert torch.get_num_threads() == 1


@pytest.mark.usefixtures("stopped")
def test_a_stopped_run_is_not_lost_by_starting_it_again(scene: Path) -> None:
    with pytest.raises(ProgdfError, match="stopped at step 10 of 24; add --resume"):
        train(small_run(scene), quiet=True)
    assert saved_step() == 10


def test_resuming_a_finished_run_says_so_and_leaves_it(
    scene: Path, uninterrupted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(uninterrupted, OUT)
    assert main(words(scene, "--resume")) == 0
    assert "nothing is left to do" in capsys.readouterr().err
    assert bits(OUT) == bits(uninterrupted)
    with pytest.raises(ProgdfError, match="--seed 0, not 1; leave --resume away"):
        train(replace(small_run(scene), resume=True, seed=1), quiet=True)


def test_resuming_where_nothing_was_saved_starts(scene: Path, uninterrupted: Path) -> None:
    assert "nothing to resume" in gone_on(scene, uninterrupted)


@pytest.mark.usefixtures("stopped")
def test_views_that_are_edited_are_not_edited_again(
    scene: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    def make_editor(*_: object) -> None:
        raise AssertionError("edited again")

    monkeypatch.setattr(trainer.run, "make_editor", make_editor)
    gone_on(scene, uninterrupted)


@pytest.mark.usefixtures("stopped")
def test_the_region_is_not_looked_for_again(
    scene: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def parse_region(*_: object) -> None:
        raise AssertionError("looked for again")

    monkeypatch.setattr(trainer.run, "parse_region", parse_region)
    gone_on(scene, uninterrupted)


@pytest.mark.parametrize("broken", ["gone", "cut short"])
@pytest.mark.usefixtures("stopped")
def test_an_edited_view_that_was_lost_is_edited_again(scene: Path, uninterrupted: Path, broken: str) -> None:
    lost = sorted((OUT / "views" / "edited").glob("*.png"))[0]
    if broken == "gone":
        lost.unlink()
    else:
        lost.write_bytes(lost.read_bytes()[:200])
    assert f"edited again: {lost} is " in gone_on(scene, uninterrupted)


def test_an_edited_view_that_vanishes_while_training_is_one_line_and_nothing_is_lost(
    scene: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lose_all() -> None:
        for path in (OUT / "views" / "edited").glob("*.png"):
            path.unlink()

    with monkeypatch.context() as patch:
        at_step(patch, 5, lose_all)
        with pytest.raises(ProgdfError, match=r"\.png is gone; train again, with --resume"):
            train(small_run(scene), quiet=True)
    assert saved_step() == 24
    gone_on(scene, uninterrupted)


def test_a_run_that_moves_parts_goes_on_to_the_same_bits(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = small_run(scene, kind="geometry", group_steps=8, steps=16)
    monkeypatch.setattr(trainer.run, "finished", lambda *_: None)
    train(options, quiet=True)
    expected = (OUT / "trajectory.safetensors").read_bytes()
    shutil.rmtree(OUT)
    with monkeypatch.context() as patch:
        at_step(patch, 11, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(options, quiet=True)

    def group_stage(*_: object) -> None:
        raise AssertionError("parts looked for again")

    monkeypatch.setattr(trainer.training, "group_stage", group_stage)
    train(replace(options, resume=True), quiet=True)
    assert (OUT / "trajectory.safetensors").read_bytes() == expected


def test_what_is_found_in_a_folder_depends_on_the_options(
    scene: Path, uninterrupted: Path, interrupted: Path
) -> None:
    assert found(small_run(scene)) == "nothing"
    shutil.copytree(interrupted, OUT)
    assert found(small_run(scene)) == "stopped"
    assert found(small_run(scene, seed=1)) == "nothing"
    shutil.rmtree(OUT)
    shutil.copytree(uninterrupted, OUT)
    assert found(small_run(scene)) == "finished"


@pytest.mark.usefixtures("stopped")
def test_a_full_disk_is_one_line_and_what_was_saved_before_goes_on(
    scene: Path, uninterrupted: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with files_up_to(40_000):  # the pictures fit in, the optimiser's state does not
        assert main(words(scene, "--resume", "--save-every=0")) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "progdf: the disk of run is full; free some space, then go on with --resume"
    assert saved_step() == 10
    assert not list(OUT.rglob(".*"))
    gone_on(scene, uninterrupted)


@pytest.mark.parametrize("size", [0, 2_000])
def test_a_disk_that_is_full_from_the_start_is_one_line(
    scene: Path, size: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with files_up_to(size):
        assert main(words(scene)) == 2
    assert "the disk of run is full; " in capsys.readouterr().err.splitlines()[-1]


def test_a_loss_that_is_not_finite_keeps_the_state_before_it(
    scene: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, true_sum = 0, trainer.pgs.summed

    def poisoned(terms: dict[str, torch.Tensor]) -> torch.Tensor:
        nonlocal calls
        calls += 1
        return true_sum(terms) * (float("nan") if calls == 13 else 1.0)

    with monkeypatch.context() as patch:
        patch.setattr(trainer.pgs, "summed", poisoned)
        with pytest.raises(ProgdfError, match="the loss is nan at step 12; the state before it is kept"):
            train(small_run(scene, save_every=NEVER), quiet=True)
    assert saved_step() == 12
    gone_on(scene, uninterrupted)


def test_a_run_folder_that_is_removed_while_training_is_one_line(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_step(monkeypatch, 5, lambda: shutil.rmtree(OUT))
    with pytest.raises(ProgdfError, match="run/state was removed during the run; train again"):
        train(small_run(scene, save_every=0.0), quiet=True)


def test_a_folder_that_cannot_be_written_is_one_line(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    OUT.mkdir()

    def mkstemp(**_: object) -> None:
        raise OSError(30, os.strerror(30), "run/.log.txt")

    monkeypatch.setattr(tempfile, "mkstemp", mkstemp)
    with pytest.raises(ProgdfError, match=r"run cannot be written \(Read-only file system\); "):
        train(small_run(scene), quiet=True)
    with pytest.raises(ProgdfError, match="cannot be made"):
        train(replace(small_run(scene), out=Path("/proc/run")), quiet=True)


def test_two_runs_in_one_folder_are_refused(scene: Path) -> None:
    OUT.mkdir()
    with locked(RunFolder(OUT)), pytest.raises(ProgdfError, match="being trained by another process; "):
        train(small_run(scene), quiet=True)


@pytest.mark.parametrize("part", ["run.json", "training.safetensors", "recordings/000001.safetensors"])
@pytest.mark.usefixtures("stopped")
def test_a_damaged_state_is_one_line(scene: Path, part: str) -> None:
    path = OUT / "state" / part
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ProgdfError, match=r"is damaged .*; delete .*state and train again"):
        train(replace(small_run(scene), resume=True), quiet=True)


def test_the_optimiser_goes_on_from_any_step_to_the_same_bits(tmp_path: Path) -> None:
    case = small("body")
    wanted = course(case, steps=6)
    straight, original = list(optimise(*wanted)), wanted[0]
    folder = StateFolder(tmp_path / "state")
    folder.begin({})

    class Stop(Exception):  # noqa: N818
        pass

    state, made = PgsState(original), []
    for _ in range(20):  # stopped after every step, every time restored into another state

        def on_step(step: int, left: float) -> None:
            raise Stop

        try:
            made.extend(snapshot for snapshot in optimise(*wanted, on_step, state))
            break
        except Stop:
            saved = state.saved()
            folder.save("pgs", saved.tensors, saved.values)
            state = PgsState(original, seed=5)
            restored = folder.load("pgs")
            assert restored is not None
            state.restore(restored)
    assert len(made) == len(straight)
    for one, other in zip(made, straight, strict=True):
        assert torch.equal(one.offsets, other.offsets)
        assert (one.step, one.stage, one.ends_stage, one.means) == (
            other.step,
            other.stage,
            other.ends_stage,
            other.means,
        )


def test_saving_waits_until_it_is_a_hundredth_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("trainer.state.time.perf_counter", lambda: now)
    folder = StateFolder(tmp_path / "state")
    folder.begin({})

    class Slow:
        def saved(self) -> Saved:
            nonlocal now
            now += 0.5  # seconds that a save takes
            return Saved({}, {})

        def restore(self, saved: Saved) -> None: ...

    kept = Autosave(folder, "training", {"slow": Slow()}, every_s=10.0)
    for _ in range(4000):
        now += 0.1
        kept.step_done()
    assert 0.5 * 0.01 < kept.seconds / now < 1.01 * 0.01
