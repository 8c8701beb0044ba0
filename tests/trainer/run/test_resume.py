"""Stopped runs: they resume to the same bits from any point, and one line tells how."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import trainer.run.run
from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply
from progdf.gaussians import ZERO
from progdf.gdf.file import load_gdf
from progdf.io.cameras import load_cameras, save_cameras
from progdf.region import Region
from tests.helpers.colmap_text import write_text_model
from tests.helpers.demo_scenes import bear
from tests.helpers.growth import write_growth
from tests.helpers.stopped import OUT, bits, small_run
from tests.helpers.stopped_runs import NEVER, at_step, gone_on, killed, saved_step, words
from tests.helpers.trained import quick_options, train
from trainer.options import EditorOptions, TrainOptions
from trainer.run import agree, command, edited_views, trained, training
from trainer.run.resume import decide_resume, explain_stop, find_run, picture_digests, processor_kind
from trainer.store.run_folder import RunFolder, open_run_folder
from trainer.store.state import StateFolder

pytest_plugins = ["tests.helpers.stopped_runs"]
pytestmark = pytest.mark.usefixtures("elsewhere")


def test_run_killed_at_any_write_resumes_to_the_same_bits(
    bear_folder: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    draw = random.Random(7)
    # while views are rendered, and in the optimization
    spans = ((2, 12), (30, 50))
    lines = killed(bear_folder, tmp_path, [float(draw.randint(*span)) for span in spans], save_every=0)
    assert any(line.endswith("-9") for line in lines), lines
    assert bits(tmp_path / OUT) == bits(uninterrupted)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "options"),
    [
        (16, {"save_every": 0.2}),
        (8, {"save_every": 0, "kind": "geometry", "group_steps": 12}),
        (4, {"save_every": 0, "field": "neural", "field_loss": "pictures", "preset": "paper"}),
    ],
    ids=["color", "parts", "joint"],
)
def test_runs_killed_at_random_moments_resume_to_the_same_bits(
    bear_folder: Path, tmp_path: Path, count: int, options: dict[str, object]
) -> None:
    killed(bear_folder, tmp_path, [], **options)
    expected = bits(tmp_path / OUT)
    shutil.rmtree(tmp_path / OUT)
    draw = random.Random(11)
    moments = [draw.choice((float(draw.randint(1, 60)), draw.uniform(0.2, 4.0))) for _ in range(count)]
    killed(bear_folder, tmp_path, moments, **options)
    assert bits(tmp_path / OUT) == expected


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_saves_the_state_and_exits_130_with_instructions(
    bear_folder: Path,
    uninterrupted: Path,
    number: signal.Signals,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    at_step(monkeypatch, 9, lambda: os.kill(os.getpid(), number))
    monkeypatch.setattr("trainer.store.state.SAVE_EVERY", NEVER)
    assert main(words(bear_folder)) == 130
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("progdf: interrupted; ")
    assert last.endswith("repeat the command with --resume to continue")
    assert saved_step() == 10
    assert "continuing at step 10 of 24" in gone_on(bear_folder, uninterrupted)


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_before_the_optimization_is_saved_too(
    bear_folder: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(edited_views, "edit_views", lambda *_: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt, match="--resume"):
            train(small_run(bear_folder), quiet=True)
    gone_on(bear_folder, uninterrupted)


@pytest.mark.usefixtures("default_signals")
def test_draft_exists_until_the_edit_is_finished(
    bear_folder: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(trainer.run.run, "_render_originals", lambda *_: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(small_run(bear_folder), quiet=True)
    draft = load_gdf(OUT / "draft.gdf", load_ply(bear_folder / "scene.ply"))
    assert (draft.name, draft.field.kind) == (small_run(bear_folder).name or "run", "grade")
    assert "dB in held-out views; training continues" in (OUT / "log.txt").read_text()
    train(replace(small_run(bear_folder), resume=True), quiet=True)
    assert bits(OUT) == bits(uninterrupted)
    assert not (OUT / "draft.gdf").exists()


def test_edit_named_draft_is_no_draft(bear_folder: Path) -> None:
    done = train(replace(small_run(bear_folder), name="draft"), quiet=True)
    assert "draft" not in load_gdf(done.gdf, load_ply(bear_folder / "scene.ply")).report


@pytest.mark.usefixtures("stopped")
def test_resume_with_another_option_names_it_and_changes_nothing(bear_folder: Path) -> None:
    before = {path: path.read_bytes() for path in OUT.rglob("*") if path.is_file()}
    with pytest.raises(ProgdfError, match="started with --steps 24, not 40; "):
        train(replace(small_run(bear_folder, steps=40), resume=True), quiet=True)
    assert {path: path.read_bytes() for path in OUT.rglob("*") if path.is_file()} == before


@pytest.mark.usefixtures("stopped")
def test_resume_with_a_changed_scene_is_refused(bear_folder: Path) -> None:
    about = OUT / "state" / "run.json"
    identity = json.loads(about.read_text(encoding="utf-8"))
    about.write_text(json.dumps({**identity, "scene": "another"}), encoding="utf-8")
    with pytest.raises(ProgdfError, match="the scene has changed since run was started; "):
        train(replace(small_run(bear_folder), resume=True), quiet=True)


@pytest.mark.parametrize("change", ["another pose", "another size", "a larger model"])
def test_resume_detects_a_changed_camera_folder(bear_folder: Path, change: str) -> None:
    cameras = Path("colmap")
    names = [f"{i} a.jpg" for i in range(8)]
    model = write_text_model(cameras / "sparse" / "0", names)
    images = (model / "images.txt").read_text(encoding="utf-8")
    options = small_run(bear_folder, cameras=cameras)
    folder = open_run_folder(OUT, options.edit)
    region = Region("part", torch.arange(4), torch.ones(9))
    begun = decide_resume(folder, options, region, 9)
    assert begun.does == "start"
    again = replace(options, resume=True)
    assert decide_resume(folder, again, region, 9).does == "go on"
    if change == "another pose":
        (model / "images.txt").write_text(images.replace(" 8 1 ", " 9 1 "), encoding="utf-8")
    elif change == "another size":
        path = model / "cameras.txt"
        path.write_text(path.read_text(encoding="utf-8").replace("640", "641"), encoding="utf-8")
    else:
        write_text_model(cameras / "sparse" / "1", [*names, "more.jpg"])
    with pytest.raises(ProgdfError, match="colmap has changed since run was started; restore it"):
        decide_resume(folder, again, region, 9)


def test_cameras_in_a_folder_are_used_for_training(bear_folder: Path) -> None:
    demo = bear(1500)
    Path("data").mkdir()
    save_cameras(Path("data", "cameras.json"), demo.cameras)
    done = train(small_run(bear_folder, cameras=Path("data")), quiet=True)
    assert done.gdf.is_file()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (IsADirectoryError(errno.EISDIR, "Is a directory", "sparse/0"), "sparse/0 cannot be read or written"),
        (FileNotFoundError(errno.ENOENT, "No such file", b"a.png"), "a.png cannot be read or written"),
        (OSError(errno.EIO, "Input/output error"), "a file of run cannot be read or written"),
        (OSError(errno.ENOSPC, "No space left", "/tmp/x"), "the disk of /tmp/x is full"),
        (OSError(errno.ENOSPC, "No space left"), "the disk of run is full"),
    ],
)
def test_system_error_names_the_file_at_fault(error: OSError, said: str) -> None:
    with pytest.raises(ProgdfError) as caught, explain_stop(RunFolder(OUT)):
        raise error
    assert str(caught.value).startswith(said)
    assert str(caught.value).endswith("then continue with --resume")


def test_missing_picture_is_named_instead_of_the_run(bear_folder: Path) -> None:
    options = small_run(bear_folder, editor="decal:logo.png")
    with pytest.raises(ProgdfError, match=r"^logo\.png does not exist; "):
        picture_digests(options)


@pytest.mark.usefixtures("stopped")
def test_run_of_another_version_is_not_resumed(bear_folder: Path) -> None:
    about = OUT / "state" / "run.json"
    identity = json.loads(about.read_text(encoding="utf-8"))
    del identity["version"]
    about.write_text(json.dumps(identity), encoding="utf-8")
    with pytest.raises(ProgdfError, match="run was started by another version of progdf; train again"):
        train(replace(small_run(bear_folder), resume=True), quiet=True)


@pytest.mark.usefixtures("stopped")
def test_resumed_run_keeps_its_number_of_threads(bear_folder: Path, uninterrupted: Path) -> None:
    assert "using 1 threads as at the start of the run" in gone_on(bear_folder, uninterrupted, threads=2)
    assert torch.get_num_threads() == 1


@pytest.mark.usefixtures("stopped")
def test_stopped_run_is_not_lost_by_starting_again(bear_folder: Path) -> None:
    with pytest.raises(ProgdfError, match="stopped at step 10 of 24; add --resume"):
        train(small_run(bear_folder), quiet=True)
    assert saved_step() == 10


def test_resume_of_a_finished_run_reports_it_and_changes_nothing(
    bear_folder: Path, uninterrupted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(uninterrupted, OUT)
    assert main(words(bear_folder, "--resume")) == 0
    assert "there is nothing left to do" in capsys.readouterr().err
    assert bits(OUT) == bits(uninterrupted)
    with pytest.raises(ProgdfError, match="--seed 0, not 1; leave out --resume"):
        train(replace(small_run(bear_folder), resume=True, seed=1), quiet=True)


def test_resume_without_saved_state_starts_the_run(bear_folder: Path, uninterrupted: Path) -> None:
    assert "nothing to resume" in gone_on(bear_folder, uninterrupted)


@pytest.mark.usefixtures("stopped")
def test_resume_repeats_no_edited_view_and_no_region_search(
    bear_folder: Path, uninterrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def again(*_: object) -> None:
        raise AssertionError("made again")

    monkeypatch.setattr(command, "parse_region", again)
    monkeypatch.setattr(agree, "make_editor", again)
    gone_on(bear_folder, uninterrupted)


@pytest.mark.parametrize("change", ["half the rows", "above 1", "whole numbers", "no name"])
@pytest.mark.usefixtures("stopped")
def test_saved_region_of_another_scene_is_a_one_line_error(bear_folder: Path, change: str) -> None:
    state = StateFolder(OUT / "state")
    saved = state.load("region")
    assert saved is not None
    members = saved.tensors["members"]
    score = saved.tensors["score"]
    half = len(score) // 2
    changed = {
        "half the rows": (members[members < half], score[:half]),
        "above 1": (members, 2 * score),
        "whole numbers": (members, score.long()),
        "no name": (members, score),
    }[change]
    values = {"name": 1e-300} if change == "no name" else saved.values
    state.save("region", dict(zip(("members", "score"), changed, strict=True)), values)
    with pytest.raises(ProgdfError, match=r"region\.safetensors is damaged \((Value|Type)Error\); delete "):
        train(replace(small_run(bear_folder), resume=True), quiet=True)


@pytest.mark.slow
@pytest.mark.parametrize("broken", ["gone", "truncated"])
@pytest.mark.usefixtures("stopped")
def test_lost_edited_view_is_edited_again(bear_folder: Path, uninterrupted: Path, broken: str) -> None:
    lost = sorted((OUT / "views" / "edited").glob("*.png"))[0]
    if broken == "gone":
        lost.unlink()
    else:
        lost.write_bytes(lost.read_bytes()[:200])
    assert f"edited again: {lost} is " in gone_on(bear_folder, uninterrupted)


@pytest.mark.usefixtures("stopped")
def test_resume_on_another_processor_is_logged_in_one_line(bear_folder: Path, uninterrupted: Path) -> None:
    about = OUT / "state" / "run.json"
    identity = json.loads(about.read_text(encoding="utf-8"))
    assert identity["processor"] == processor_kind()
    about.write_text(json.dumps({**identity, "processor": "znver4, AVX2"}), encoding="utf-8")
    log = gone_on(bear_folder, uninterrupted)
    assert log.count("the processor was znver4, AVX2 and is ") == 1
    assert log.count("the last bits may differ, the quality does not") == 1


def test_processor_kind_includes_switches_that_change_the_last_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kinds = [processor_kind()]
    monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda: "OTHER")
    kinds.append(processor_kind())
    monkeypatch.setattr("numba.config.CPU_NAME", "another")
    kinds.append(processor_kind())
    monkeypatch.setenv("MKL_ENABLE_INSTRUCTIONS", "SSE4_2")
    kinds.append(processor_kind())
    assert len(set(kinds)) == 4


@pytest.mark.slow  # the fast tests stop a run of colors; parts and their rows are saved by the same code
def test_run_that_moves_parts_resumes_to_the_same_bits(
    bear_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = small_run(bear_folder, kind="geometry", group_steps=8, steps=16)
    monkeypatch.setattr(trained, "finish_run", lambda *_: None)
    train(options, quiet=True)
    expected = (OUT / "trajectory.safetensors").read_bytes()
    shutil.rmtree(OUT)
    with monkeypatch.context() as patch:
        at_step(patch, 11, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(options, quiet=True)

    def group_stage(*_: object) -> None:
        raise AssertionError("parts looked for again")

    monkeypatch.setattr(training, "group_stage", group_stage)
    train(replace(options, resume=True), quiet=True)
    assert (OUT / "trajectory.safetensors").read_bytes() == expected


@pytest.mark.slow  # the fast tests kill a plain run at its writes
def test_run_that_chooses_its_strengths_resumes_to_the_same_bits(
    bear_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stop while views are edited at the chosen strengths, then between two strengths."""
    free = {"perceptual_weight": None, "steps": 200, "stages": 0, "views": 0, "image_size": 40}
    options = small_run(bear_folder, field="auto", **free)
    monkeypatch.setattr(trained, "finish_run", lambda *_: None)
    train(options, quiet=True)
    expected = (OUT / "trajectory.safetensors").read_bytes()
    shutil.rmtree(OUT)
    monkeypatch.setattr("trainer.store.state.SAVE_EVERY", 0.0)
    requested: list[list[float]] = []

    def edit_views(*given: Any, made: Callable[..., object] = edited_views.edit_views) -> object:
        requested.append(list(given[2]))
        if len(requested) == 3:
            raise KeyboardInterrupt
        return made(*given)

    with monkeypatch.context() as patch:
        patch.setattr(edited_views, "edit_views", edit_views)
        with pytest.raises(KeyboardInterrupt):
            train(options, quiet=True)
    # the full and the half edit come first; their difference decides on the other strengths
    assert requested[:2] == [[1.0], [0.5]]
    assert len(requested[2]) > 1
    with monkeypatch.context() as patch:
        at_step(patch, 2, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(replace(options, resume=True), quiet=True)
    assert saved_step() > 0
    train(replace(options, resume=True), quiet=True)
    assert (OUT / "trajectory.safetensors").read_bytes() == expected


def test_state_of_a_folder_depends_on_the_options(
    bear_folder: Path, uninterrupted: Path, interrupted: Path
) -> None:
    assert find_run(small_run(bear_folder)) == "nothing"
    shutil.copytree(interrupted, OUT)
    assert find_run(small_run(bear_folder)) == "stopped"
    assert find_run(small_run(bear_folder, seed=1)) == "nothing"
    shutil.rmtree(OUT)
    shutil.copytree(uninterrupted, OUT)
    assert find_run(small_run(bear_folder)) == "finished"


@pytest.mark.slow  # the fast tests kill a plain run at its writes
def test_run_killed_while_growing_resumes_to_the_same_bits(tmp_path: Path) -> None:
    options = write_growth(tmp_path, "hat", views=8, image_size=64)
    more = {"editor": options.editor.editor, "region": options.region.region, "views": options.views.views}
    more |= {"grow": 0.5, "kind": "geometry", "group_steps": 0, "save_every": 0, "image_size": 64}
    for name in ("whole", "cut"):
        (tmp_path / name).mkdir()
    killed(tmp_path, tmp_path / "whole", [], **more)
    log = (tmp_path / "whole" / OUT / "log.txt").read_text(encoding="utf-8")
    assert "Gaussians added, of" in log
    # in the trial, near the file of the rows, and in the joint optimization
    lines = killed(tmp_path, tmp_path / "cut", [31.0, 44.0, 15.0, 19.0, 24.0], **more)
    assert sum(line.endswith("-9") for line in lines) == 5, lines
    assert bits(tmp_path / "cut" / OUT) == bits(tmp_path / "whole" / OUT)


def _striped(bear_folder: Path) -> TrainOptions:
    """Return options of a run that chooses its views and strengths and needs half of the views."""
    options = quick_options(bear_folder, views=0, stages=0, image_size=48)
    return replace(options, out=OUT, editor=EditorOptions("stripes:#20a040"))


@pytest.fixture(scope="session")
def striped_bits(bear_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the bits of such a run without interruption; check the views that it kept."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("striped"))
        whole = train(_striped(bear_folder))
        effort = whole.report["effort"]
        names = {path.stem for path in (OUT / "views/original").glob("*.png")}
        solved = effort["views"]
        assert len(effort["strengths"]) > 2
        assert len(names) == solved + len(whole.report["views"]["edit"])
        assert f"solving for {solved} of {2 * solved} views" in (OUT / "log.txt").read_text(encoding="utf-8")
        assert {camera.name for camera in load_cameras(OUT / "cameras.json", ZERO)} == names
        for s in effort["strengths"][:-1]:
            assert {path.stem for path in (OUT / "views/edited" / f"{s:g}").glob("*.png")} == names
        return bits(OUT)


@pytest.mark.slow  # the fast tests kill a plain run at its writes
@pytest.mark.parametrize("where", ["a lost view", "step 2", "write_finals", "finish_run"])
def test_run_that_keeps_half_of_its_views_resumes_to_the_same_bits(
    bear_folder: Path, striped_bits: dict[str, str], monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    loses_a_view = where == "a lost view"
    options = _striped(bear_folder)
    with monkeypatch.context() as patch:
        if loses_a_view or where == "step 2":
            at_step(patch, 2, lambda: os.kill(os.getpid(), signal.SIGINT))
        else:
            patch.setattr(trained, where, stop)
        with pytest.raises(KeyboardInterrupt):
            train(options)
    if loses_a_view:
        next((OUT / "views/edited").glob("*/orbit_*.png")).unlink()
    train(replace(options, resume=True))
    assert bits(OUT) == striped_bits
    assert ("edited again" in (OUT / "log.txt").read_text(encoding="utf-8")) == loses_a_view
