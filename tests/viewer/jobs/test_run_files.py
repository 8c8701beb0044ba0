"""Where the runs of a scene lie, and what is read of them while they run."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.region import Region
from tests.helpers.ui_rig import bear
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder
from viewer.jobs import run_files
from viewer.jobs.training_job import EditOrder, Progress


def order(folder: Path, name: str = "blue") -> EditOrder:
    scene = folder / "bear.ply"
    scene.touch()
    home = run_files.edits_folder(scene, folder / "memory")
    return EditOrder(scene.resolve(), run_files.free_run(home, name), name, "all", "recolor:#3060d0")


def test_runs_lie_beside_their_scene_or_where_the_user_may_write(tmp_path: Path) -> None:
    scene = tmp_path / "there" / "bear.ply"
    scene.parent.mkdir()
    scene.touch()
    assert run_files.edits_folder(scene, tmp_path / "memory") == scene.parent / "bear.edits"
    scene.parent.chmod(0o555)
    try:
        elsewhere = run_files.edits_folder(scene, tmp_path / "memory")
    finally:
        scene.parent.chmod(0o755)
    assert elsewhere.parent == tmp_path / "memory" / "edits"
    assert elsewhere.name.startswith("bear-")


def test_a_run_that_was_stopped_is_found_again_and_can_be_discarded(tmp_path: Path) -> None:
    asked = order(tmp_path)
    run_files.keep_order(asked)
    assert [*run_files.stopped_orders(asked.out.parent, asked.scene)] == [], "it has not begun"
    (asked.out / "state").mkdir(parents=True)
    (asked.out / "state" / "run.json").write_text("{}")
    assert [*run_files.stopped_orders(asked.out.parent, asked.scene)] == [asked]
    assert [*run_files.stopped_orders(asked.out.parent, tmp_path / "other.ply")] == []
    assert order(tmp_path).out.name == "blue-2", "its name is taken"
    run_files.discard(asked)
    assert [*asked.out.parent.iterdir()] == []


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        b'{"scene": "a.ply", "na',
        b"\xff\xfe{}",
        b'{"label": "\xff", "share": 0.5}',
        b'{"scene": "\xff", "name": "", "region": "", "editor": "", "quick": true}',
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b"1" * 5000,
        b"null",
        b'{"label": 1, "share": 1e400}',
        b'{"label": "Training", "share": 0.5, "seconds": -1}',
        b'{"scene": "\\ud800", "label": "\\ud800", "share": 1.5}',
        b" " * (1 << 21),
        None,
    ],
    ids=lambda content: "a folder" if content is None else ascii(content[:20]),
)
def test_a_damaged_file_of_a_run_is_passed_over(tmp_path: Path, damaged: bytes | None) -> None:
    asked, good = order(tmp_path), order(tmp_path, "gold")
    for kept in (asked, good):
        run_files.keep_order(kept)
        (kept.out / "state").mkdir(parents=True)
        (kept.out / "state" / "run.json").write_text("{}")
    told = asked.out.with_name("blue.train.json"), asked.out / "state" / "progress.json"
    told[0].unlink()
    for path in told:
        if damaged is None:
            path.mkdir()
        else:
            path.write_bytes(damaged)
    assert [*run_files.stopped_orders(asked.out.parent, asked.scene)] == [good]
    assert run_files.read_progress(asked, Progress(0.1)) == Progress(0.1)


def test_a_run_whose_files_are_pipes_is_not_waited_for(tmp_path: Path) -> None:
    asked = order(tmp_path)
    (asked.out / "state").mkdir(parents=True)
    (asked.out / "state" / "run.json").write_text("{}")
    for path in (asked.out.with_name("blue.train.json"), asked.out / "state" / "progress.json"):
        os.mkfifo(path)
    assert [*run_files.stopped_orders(asked.out.parent, asked.scene)] == []
    assert run_files.read_progress(asked, Progress(0.1)) == Progress(0.1)


def test_what_cannot_be_removed_is_whole_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = order(tmp_path)
    run_files.keep_order(asked)
    (asked.out / "state").mkdir(parents=True)
    (asked.out / "state" / "run.json").write_text("{}")

    def refuse(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        with pytest.raises(ProgdfError, match=r"cannot be removed \(Permission"):
            run_files.discard(asked)
    assert [*run_files.stopped_orders(asked.out.parent, asked.scene)] == [asked]
    elsewhere = tmp_path / "elsewhere"
    (asked.out / "state").rename(elsewhere)
    (asked.out / "state").symlink_to(elsewhere)
    with pytest.raises(ProgdfError, match="behind a link"):
        run_files.discard(asked)
    assert (elsewhere / "run.json").is_file()


@pytest.mark.parametrize("name", ["..", ".", "", "...", "link"])
def test_no_order_of_a_stranger_makes_another_folder_a_run(name: str, tmp_path: Path) -> None:
    asked = order(tmp_path)
    run_files.keep_order(asked)
    edits, other = asked.out.parent, tmp_path / "other"
    for folder in (tmp_path, edits, other):
        (folder / "state").mkdir(parents=True)
        (folder / "state" / "run.json").write_text("{}")
    (edits / "link").symlink_to(other)
    edits.joinpath("blue.train.json").rename(edits / f"{name}.train.json")
    assert [*run_files.stopped_orders(edits, asked.scene)] == []


def test_a_finished_edit_is_never_discarded(tmp_path: Path) -> None:
    asked = order(tmp_path)
    asked.out.mkdir(parents=True)
    asked.gdf.touch()
    run_files.discard(asked)
    assert asked.gdf.exists()


def test_the_trainer_s_progress_and_recordings_are_read_as_it_writes_them(tmp_path: Path) -> None:
    asked, scene = order(tmp_path), bear().scene
    folder = RunFolder(asked.out)
    assert run_files.read_progress(asked, Progress(0.1)) == Progress(0.1)
    assert run_files.newest_recording(asked) is None
    folder.state.path.mkdir(parents=True)
    log = RunLog(folder.log, quiet=True, progress=folder.progress)
    with log.steps("optimize", 10) as advance:
        advance(10, "loss to the edit 0.5")
    log.close()
    told = run_files.read_progress(asked, Progress())
    assert (told.share, told.label, told.loss) == (0.64, "Training", "0.5")
    assert told.seconds > 0.0, "for the question whether to discard it"
    later = Progress(0.9, "Packing", "", 1e6)
    assert run_files.read_progress(asked, later) == Progress(0.9, "Training", "0.5", 1e6), "never back"
    members = torch.tensor([1, 5])
    region = Region("blue", members, torch.zeros(len(scene)).index_fill(0, members, 1.0))
    folder.state.save("region", {"members": region.members, "score": region.score}, {"name": "blue"})
    offsets = torch.zeros(2, 14)
    offsets[:, -3:] = 0.25
    for index in range(2):
        folder.state.save("recordings", {"offsets": (offsets * index).half()}, {}, index)
    newest = run_files.newest_recording(asked)
    assert newest is not None
    assert newest.name.startswith("000001")
    edit = run_files.recorded_edit(asked, newest, scene)
    assert edit is not None
    assert torch.equal(edit.field.offsets(1.0), offsets)
    assert run_files.recorded_edit(asked, newest, scene[:10]) is None, "another scene"
