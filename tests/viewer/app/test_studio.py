"""New edits in the window with a stub of the trainer that finishes on demand."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import torch
from imgui_bundle import imgui
from PIL import Image

from progdf.__main__ import main
from progdf.compose import layer_paint
from progdf.formats.ply import save_ply
from progdf.gdf.file import fingerprint, save_gdf
from progdf.io.atomic import state_folder
from progdf.io.picture_camera import camera_chunk, camera_file, find_picture_camera, layers_in_picture
from progdf.scene.regions import parse_region
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import bear, first_view
from trainer.store.run_folder import RunFolder
from viewer.app import app as application
from viewer.app.parts.preview import PAINT_TEXT
from viewer.camera.view_camera import first_camera, to_camera
from viewer.files import region_files
from viewer.files.document import empty
from viewer.files.session import open_session
from viewer.files.user_files import load_thumbnail
from viewer.jobs import job_queue
from viewer.state import selection
from viewer.state.commands import Action, OnItem, Plain, WithText
from viewer.state.forms import CHANGED, SELECTION, TURNTABLE, TYPED
from viewer.state.view_state import ViewState

pytestmark = pytest.mark.gl


class Trainer:
    """Stub of a child process: it runs until `ended` is set and then leaves an edit."""

    said: Sequence[str] = ()
    ended: int | None = None
    line = ""
    edit: Path | None = None

    def __init__(self, arguments: Sequence[str], log: Path, talks: bool = False) -> None:
        type(self).said = arguments
        self.log = log

    @property
    def status(self) -> int | None:
        if self.ended == 0 and self.edit is not None:
            out = Path(next(word for word in self.said if word.startswith("--out=")).removeprefix("--out="))
            out.mkdir(parents=True, exist_ok=True)
            shutil.copy(self.edit, out / f"{out.name}.gdf")
        return self.ended

    def stop(self, grace_s: float = 0.0) -> None:
        type(self).ended = 130

    def close(self) -> None:
        pass

    def error(self) -> str:
        return self.line


@pytest.fixture
def window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[application.App]:
    folder = bear_files(tmp_path)
    monkeypatch.setattr(job_queue, "Child", Trainer)
    Trainer.ended = None
    Trainer.line = ""
    Trainer.edit = folder / "edits" / "scarf.gdf"
    with null_app(
        replace(opened_document(folder), edits=(), gdf_paths=()), first_view(bear()), folder
    ) as app:
        app.main_view.store.replace(
            replace(app.main_view.work, form=replace(app.main_view.work.form, preview=False, name="blue"))
        )
        yield app


def turn(app: application.App) -> None:
    """Run one turn of the window's loop."""
    app._wait_times()
    app.draw()


def request(app: application.App, action: Action) -> None:
    app.main_view.messages.request(action)
    app.draw()
    turn(app)


def test_trained_edit_becomes_a_layer_at_full_strength(window: application.App) -> None:
    press(window, "Ctrl+N")
    assert window.main_view.work.form_open
    request(window, Plain("train"))
    assert not window.main_view.work.form_open
    (job,) = window.parts.jobs.queue.jobs
    assert (job.status, job.task.name) == ("running", "blue")
    assert "--editor=recolor:#3061d1" in Trainer.said
    Trainer.ended = 0
    turn(window)
    assert window.main_view.work.jobs == ()
    (layer,) = window.main_view.work.view.layers
    assert (layer.name, layer.strength) == ("scarf", 1.0)
    press(window, "Ctrl+Z")
    assert window.main_view.work.view.layers == ()


def test_selection_is_the_region_of_a_new_edit(window: application.App) -> None:
    view = window.main_view.work.view
    total = len(window.documents.get().scene)
    mask = selection.unpack(selection.EMPTY_MASK, total).copy()
    mask[[3, 7]] = True
    chosen = selection.select(view.selection, mask)
    window.main_view.store.replace(replace(window.main_view.work, view=replace(view, selection=chosen)))
    press(window, "Ctrl+N")
    assert window.main_view.work.form.region == SELECTION
    request(window, Plain("train"))
    region = next(word for word in Trainer.said if word.startswith("--region="))
    assert region.startswith("--region=file:")
    assert region.endswith("blue.region.npy")
    after = window.main_view.work.view.selection
    assert (after.count, [kept.name for kept in after.regions]) == (0, ["blue"]), "it is a region now"


def test_changed_selection_is_a_new_file_for_the_preview(window: application.App, tmp_path: Path) -> None:
    """The preview process reads a file once, so a reused name would show the first selection."""
    view = window.main_view.work.view
    total = len(window.documents.get().scene)
    specs = []
    for row in (3, 7, 3):
        mask = np.zeros(total, bool)
        mask[row] = True
        chosen = selection.select(view.selection, mask)
        form = replace(window.main_view.work.form, region=SELECTION)
        specs.append(region_files.region_option(form, tmp_path, chosen, total))
        assert parse_region(specs[-1], window.documents.get().scene).members.tolist() == [row]
    assert specs[0] == specs[2] != specs[1]


def test_invalid_edit_is_reported_in_the_form(window: application.App) -> None:
    press(window, "Ctrl+N")
    form = replace(window.main_view.work.form, region=TYPED, typed_region="cube:1")
    window.main_view.store.replace(replace(window.main_view.work, form=form))
    request(window, Plain("train"))
    assert window.main_view.work.form_open
    assert window.main_view.work.form.error.startswith("unknown region 'cube:1'")
    assert window.main_view.work.jobs == ()


def test_edit_becomes_the_layer_before_its_report_ends(window: application.App) -> None:
    request(window, Plain("train"))
    (job,) = window.parts.jobs.queue.jobs
    order = job.task
    draft = job.task.out / "draft.gdf"
    draft.parent.mkdir(parents=True)
    scarf = bear().gdfs[0]
    save_gdf(draft, replace(scarf, instruction="a draft"))
    turn(window)
    (layer,) = window.main_view.work.view.layers
    assert window.documents.get().edits[layer.gdf].instruction == "a draft"
    before = order.draft.read_bytes()
    save_gdf(order.result, replace(scarf, instruction="trained"))
    window.parts.jobs._live_due = 0.0
    turn(window)
    assert [edit.instruction for edit in window.documents.get().edits] == ["a draft"]
    order.result.with_name("report.json").write_text("{}")
    turn(window)
    assert [edit.instruction for edit in window.documents.get().edits] == ["trained"]
    assert window.documents.get().gdf_paths == (order.result,)
    assert window.main_view.work.view.layers == (layer,), "the layer stays as it is"
    assert order.draft.read_bytes() == before, "a film of it and a saved session name it"
    assert window.main_view.work.message.text == f"“{order.name}” is ready"
    (card,) = window.main_view.work.jobs
    assert (card.status, card.delivered) == ("running", True)
    assert not window.parts.jobs.holds_window(), "a report does not hold the window"
    window.main_view.messages.show("another message")
    Trainer.ended = 0
    turn(window)
    assert window.main_view.work.message.text == "another message", "the layer is announced once"
    assert window.main_view.work.view.layers == (layer,), "no second layer"
    assert window.main_view.work.jobs == ()


def test_stopped_report_leaves_the_layer(window: application.App) -> None:
    request(window, Plain("train"))
    (job,) = window.parts.jobs.queue.jobs
    order = job.task
    state = order.out / "state"
    state.mkdir(parents=True)
    (state / "run.json").write_text("{}")
    save_gdf(order.result, bear().gdfs[0])
    order.result.with_name("report.json").write_text("{}")
    turn(window)
    window.parts.jobs.queue.stop(job.number)
    Trainer.ended = 130
    turn(window)
    (card,) = window.main_view.work.jobs
    assert (card.status, card.delivered, card.keepable) == ("stopped", True, False)
    request(window, OnItem("discard_run", job.number))
    assert window.main_view.work.jobs == ()
    assert order.result.is_file(), "only the report is given up"
    assert not state.exists()
    assert len(window.main_view.work.view.layers) == 1


def take_view(window: application.App) -> Path:
    """Take the view of the window; return its picture as a cropped JPEG of another name, painted over."""
    folder = window.main_view.pictures
    press(window, "Ctrl+F2")
    (taken,) = folder.glob("*_001.png")
    picture = Image.open(taken).convert("RGB")
    picture.paste((250, 0, 250), (10, 10, 90, 60))
    changed = folder / "from elsewhere.jpg"
    picture.crop((0, 0, picture.width - 40, picture.height - 30)).save(changed, quality=85)
    return changed


def test_picture_without_a_camera_is_found_among_taken_views(window: application.App, tmp_path: Path) -> None:
    window.main_view.pictures = tmp_path
    before = window.main_view.work.view.camera
    changed = take_view(window)
    window.main_view.store.change(
        replace(window.main_view.work.view, camera=replace(before, azimuth=before.azimuth + 70.0))
    )
    turn(window)
    window.parts.file_actions.open(changed)
    turn(window)
    work = window.main_view.work
    assert work.dialog is None
    assert work.form_open
    assert work.form.pictures == str(changed)
    assert work.message is not None
    assert work.message.text.startswith("Found the view of from elsewhere.jpg: ")
    assert work.view.camera.azimuth == pytest.approx(before.azimuth, abs=0.01)
    assert find_picture_camera(changed).width == Image.open(changed).width


@pytest.mark.parametrize("answer", ["use_view", "keep_view"])
def test_unknown_picture_asks_for_its_view(window: application.App, tmp_path: Path, answer: str) -> None:
    unknown = tmp_path / "unknown.png"
    Image.effect_noise((90, 70), 90).save(unknown)
    before = window.main_view.work.view.camera
    window.parts.file_actions.open(unknown)
    turn(window)
    dialog = window.main_view.work.dialog
    assert dialog is not None
    assert (dialog.kind, dialog.text) == ("match", str(unknown))
    assert not window.main_view.work.form_open
    request(window, WithText("use_view", str(unknown)) if answer == "use_view" else Plain("keep_view"))
    assert window.main_view.work.form_open == (answer == "use_view")
    assert camera_file(unknown).exists() == (answer == "use_view")
    if answer == "keep_view":
        assert window.main_view.work.view.camera == before
        assert "unknown.camera.json" in window.main_view.work.message.text


@pytest.mark.parametrize(("warning", "card"), [("", False), ("41 % of the paint was reproduced", True)])
def test_reproduced_share_of_paint_is_in_the_message_or_on_a_card(
    window: application.App, warning: str, card: bool
) -> None:
    request(window, Plain("train"))
    (job,) = window.parts.jobs.queue.jobs
    paint = {"pixels": 9, "summary": warning or "98 % of the paint was reproduced", "warning": warning}
    job.task.out.mkdir(parents=True)
    (job.task.out / "report.json").write_text(json.dumps({"paint": paint}))
    Trainer.ended = 0
    turn(window)
    message = window.main_view.work.message
    assert message is not None
    ending = "" if card else ". 98 % of the paint was reproduced"
    assert message.text == f"“{job.task.name}” is ready{ending}"
    assert not message.error
    assert [shown.warning for shown in window.main_view.work.jobs] == [warning] * card


def finish_with_offer(window: application.App) -> int:
    """Train an edit whose report offers to continue; return the number of its job."""
    request(window, Plain("train"))
    (job,) = window.parts.jobs.queue.jobs
    out = job.task.out
    out.mkdir(parents=True)
    found = {"offered": True, "explained": 0.974, "unchanged": 1249}
    (out / "report.json").write_text(json.dumps({"carry_on": found}))
    camera = to_camera(replace(window.main_view.work.view.camera, azimuth=160.0), 160, 120)
    Image.new("RGB", (160, 120), (10, 90, 200)).save(out / "behind.png", pnginfo=camera_chunk(camera))
    Trainer.ended = 0
    turn(window)
    Trainer.ended = None
    return job.number


def test_edit_from_one_picture_offers_to_continue_all_around(window: application.App) -> None:
    number = finish_with_offer(window)
    (card,) = window.main_view.work.jobs
    assert card.offer == (
        "One color map explains 97 % of the change. It can also color 1 249 splats that the picture does "
        "not show, as a guess."
    )
    view = window.main_view.work.view
    (layer,) = view.layers
    members = len(window.documents.get().gdfs[layer.gdf].region)
    painted = layer_paint.encode(np.linspace(0, 1, members, dtype=np.float32))
    window.main_view.store.change(replace(view, layers=(replace(layer, strength=0.7, paint=painted),)))
    request(window, OnItem("carry_on", number))
    assert "--carry-on=always" in Trainer.said
    assert "--name=blue all around" in Trainer.said
    (job,) = window.parts.jobs.queue.jobs
    job.task.out.mkdir()
    save_gdf(job.task.out / "draft.gdf", bear().gdfs[0])
    turn(window)
    assert len(window.main_view.work.view.layers) == 1, "no second layer while it trains"
    Trainer.ended = 0
    turn(window)
    (continued,) = window.main_view.work.view.layers
    assert window.documents.get().gdf_paths[continued.gdf] == job.task.result
    assert continued.strength == 0.7
    assert continued.paint == painted, "both edits have the same members"
    assert window.main_view.work.jobs == ()
    press(window, "Ctrl+Z")
    (before,) = window.main_view.work.view.layers
    assert window.documents.get().gdf_paths[before.gdf].parent.name == "blue"


def test_continued_edit_is_shown_from_behind_until_the_view_moves(window: application.App) -> None:
    number = finish_with_offer(window)
    request(window, OnItem("look_behind", number))
    cover = window.main_view.work.transient.cover
    assert cover is not None
    assert cover.name == "Continued all around"
    assert cover.camera == window.main_view.work.view.camera
    assert cover.camera.azimuth == pytest.approx(160.0, abs=0.01)
    turn(window)
    assert window.main_view.work.transient.cover == cover
    view = window.main_view.work.view
    window.main_view.store.change(replace(view, camera=replace(view.camera, azimuth=10.0)))
    turn(window)
    assert window.main_view.work.transient.cover is None


def test_view_painted_in_another_program_is_shown_on_every_save(
    window: application.App, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = list[Path]()
    monkeypatch.setattr("viewer.app.parts.preview.open_in_program", lambda path: opened.append(path) or True)
    press(window, "Ctrl+N")
    request(window, Plain("paint_view"))
    (path,) = opened
    form = window.main_view.work.form
    size = window.main_view.picture_size
    assert (form.choice.kind, form.region, form.pictures) == ("pictures", CHANGED, str(path))
    turn(window)
    assert (window.main_view.work.transient.cover, window.main_view.work.transient.preview.text) == (
        None,
        PAINT_TEXT,
    )

    def save(picture: Image.Image | bytes) -> str:
        if isinstance(picture, bytes):
            path.write_bytes(picture)
        else:
            picture.save(path)
        os.utime(path, ns=(time.time_ns() + next(later),) * 2)
        turn(window)
        return window.main_view.work.transient.preview.text

    later, taken = count(1_000_000, 1_000_000), Image.open(path).convert("RGB")
    assert taken.size == size
    taken.paste((250, 0, 250), (10, 10, 60, 60))
    save(taken)
    cover = window.main_view.work.transient.cover
    assert cover is not None
    assert (cover.camera, cover.size, cover.name) == (window.main_view.work.view.camera, size, "Painted")
    whole = path.read_bytes()
    assert save(whole[:4000]) == "This is the saved picture. Train makes it an edit.", (
        "half a file is not looked at"
    )
    message = f"has 40×30 pixels instead of {size[0]}×{size[1]}; save it at its original size"
    assert save(taken.resize((40, 30))).endswith(message)
    assert window.main_view.work.transient.cover is None
    save(taken)
    assert window.main_view.work.transient.cover is not None
    assert find_picture_camera(path).height == size[1], "though the program dropped what the picture carried"
    assert layers_in_picture(path) is None, "no layer is visible"
    request(window, Plain("train"))
    assert f"--editor=pictures:{path}" in Trainer.said
    turn(window)
    assert window.main_view.work.transient.cover is None, "the form is closed"


def test_failed_training_is_one_line_with_its_log(window: application.App) -> None:
    request(window, Plain("train"))
    Trainer.ended = 2
    Trainer.line = "the disk is full"
    turn(window)
    (job,) = window.parts.jobs.queue.jobs
    assert (job.status, job.error) == ("failed", "the disk is full")
    assert window.main_view.work.message is None, "its card says it, and nothing else"
    request(window, OnItem("run_log", job.number))
    assert window.main_view.work.dialog is not None
    assert window.main_view.work.dialog.kind == "log"
    press(window, "Enter")
    request(window, OnItem("discard_run", job.number))
    assert window.main_view.work.jobs == ()


def test_training_is_discarded_only_after_a_question(window: application.App) -> None:
    request(window, Plain("train"))
    (job,) = window.parts.jobs.queue.jobs
    state = job.task.out / "state"
    state.mkdir(parents=True)
    (state / "run.json").touch()
    (state / "progress.json").write_text('{"share": 0.5, "label": "Training", "seconds": 2280}')
    request(window, OnItem("stop_run", job.number))
    turn(window)
    assert window.main_view.work.jobs[0].status == "stopped"
    request(window, OnItem("ask_discard", job.number))
    dialog = window.main_view.work.dialog
    assert dialog is not None
    assert (dialog.kind, dialog.text) == ("discard_run", "38 min")
    press(window, "Enter")
    assert window.main_view.work.dialog is None
    assert state.is_dir(), "Enter keeps it"
    request(window, OnItem("ask_discard", job.number))
    press(window, "D")
    turn(window)
    assert window.main_view.work.jobs == ()
    assert not job.task.out.exists()


def record(out: Path, count: int, scene_size: int) -> torch.Tensor:
    """Save a run of two members with its recordings; return the offsets of the last one. [2,14]"""
    state = RunFolder(out).state
    state.path.mkdir(parents=True)
    (state.path / "run.json").touch()
    members = torch.tensor([1, 5])
    score = torch.zeros(scene_size).index_fill(0, members, 1.0)
    state.save("region", {"members": members, "score": score}, {"name": "blue"})
    offsets = torch.zeros(2, 14)
    offsets[:, -3:] = 0.25
    for index in range(count):
        state.save("recordings", {"offsets": (offsets * (index + 1)).half()}, {}, index)
    return offsets * count


def test_stopped_training_can_be_kept_as_it_is(window: application.App) -> None:
    request(window, Plain("train"))
    (job,) = window.parts.jobs.queue.jobs
    offsets = record(job.task.out, 2, len(window.documents.get().original))
    assert not window.main_view.work.jobs[0].keepable, "it still runs"
    request(window, OnItem("stop_run", job.number))
    turn(window)
    assert window.main_view.work.jobs[0].keepable
    request(window, OnItem("keep_run", job.number))
    (layer,) = window.main_view.work.view.layers
    assert (layer.name, layer.strength) == ("blue", 1.0)
    document = window.documents.get()
    assert document.gdf_paths == (job.task.kept_edit,)
    assert torch.allclose(document.edits[0].field.offsets(1.0), offsets, atol=2e-3)
    assert not window.main_view.work.jobs[0].keepable, "it is a layer"
    request(window, OnItem("discard_run", job.number))
    assert job.task.kept_edit.is_file()
    press(window, "Ctrl+Z")
    assert window.main_view.work.view.layers == ()


def test_stopped_training_without_recordings_has_nothing_to_keep(window: application.App) -> None:
    request(window, Plain("train"))
    (job,) = window.parts.jobs.queue.jobs
    record(job.task.out, 0, 10)
    request(window, OnItem("stop_run", job.number))
    turn(window)
    assert not window.main_view.work.jobs[0].keepable
    request(window, OnItem("keep_run", job.number))
    message = window.main_view.work.message
    assert message is not None
    assert message.text == "blue has no recording that is not a layer yet; resume it"


def test_stopped_training_with_a_draft_keeps_that(window: application.App) -> None:
    request(window, Plain("train"))
    (job,) = window.parts.jobs.queue.jobs
    record(job.task.out, 1, len(window.documents.get().original))
    job.task.draft.touch()
    request(window, OnItem("stop_run", job.number))
    turn(window)
    assert not window.main_view.work.jobs[0].keepable, "a recording may be of a lower strength than the draft"


def test_run_locked_by_another_window_is_left_alone(window: application.App) -> None:
    request(window, Plain("train"))
    (job,) = window.parts.jobs.queue.jobs
    (job.task.out / "state").mkdir(parents=True)
    (job.task.out / "state" / "run.json").touch()
    request(window, OnItem("stop_run", job.number))
    turn(window)
    with job.task.lock():
        for action in ("resume_run", "discard_run"):
            request(window, OnItem(action, job.number))
            message = window.main_view.work.message
            if action == "resume_run":
                assert message is not None
                assert message.text == "blue trains in another window; stop it there first"
            assert window.main_view.work.jobs[0].status == "stopped"
    assert (job.task.out / "state" / "run.json").is_file()


def test_quitting_asks_while_a_training_runs(window: application.App) -> None:
    request(window, Plain("train"))
    press(window, "Ctrl+Q")
    assert window.main_view.work.dialog is not None
    assert window.main_view.work.dialog.kind == "training"
    press(window, "Enter")
    assert not window.is_closed
    press(window, "Ctrl+Q", "S")
    for _ in range(3):
        turn(window)
    assert window.is_closed


def test_scene_export_runs_the_command(window: application.App, tmp_path: Path) -> None:
    press(window, "Ctrl+E")
    dialog = window.main_view.work.dialog
    assert dialog is not None
    assert dialog.text == str(tmp_path / "bear_edited.ply")
    press(window, "Enter")
    assert window.main_view.work.dialog is None
    turn(window)
    assert Trainer.said[0] == "export"
    assert Trainer.said[1] == f"--out={tmp_path / 'bear_edited.ply'}"
    assert [job.status for job in window.main_view.work.jobs] == ["running"]
    Trainer.ended = 0
    turn(window)
    (job,) = window.parts.jobs.queue.jobs
    assert job.status == "done", "it stays until it is closed"
    request(window, OnItem("copy_path", job.number))
    assert imgui.get_clipboard_text() == str(tmp_path / "bear_edited.ply")
    request(window, OnItem("close_run", job.number))
    assert window.main_view.work.jobs == ()
    Trainer.ended = None
    press(window, "Ctrl+Alt+P")
    (tmp_path / "bear_edited.png").touch()
    press(window, "Enter")
    dialog = window.main_view.work.dialog
    assert dialog is not None
    assert dialog.error == "bear_edited.png exists; give another name, or press again to replace it"
    press(window, "Enter")
    assert window.main_view.work.dialog is None
    turn(window)
    assert Trainer.said[0] == "render"
    Trainer.ended = 0
    turn(window)
    Trainer.ended = None
    press(window, "Ctrl+Shift+P")
    dialog = window.main_view.work.dialog
    assert dialog is not None
    assert dialog.options is not None
    assert dialog.options.can_move == (TURNTABLE,), "a film needs no edit"
    press(window, "Enter")
    for _ in range(2):
        turn(window)
    film = json.loads(Path(Trainer.said[-1]).read_text(encoding="utf-8"))["view"]["timeline"]
    assert len({key["camera"]["azimuth"] for key in film["keys"]}) == len(film["keys"]) == 96


def test_web_page_export_runs_the_command_with_the_snapshots(window: application.App) -> None:
    press(window, "F5", "Ctrl+Shift+E")
    dialog = window.main_view.work.dialog
    assert dialog is not None
    assert dialog.text.endswith("bear_edited.html")
    press(window, "Enter")
    turn(window)
    assert Trainer.said[:3] == ("export", f"--out={dialog.text}", "--title=bear")
    assert len(open_session(Path(Trainer.said[-1])).snapshots) == 1


def test_quitting_asks_while_a_file_is_written(window: application.App, tmp_path: Path) -> None:
    (tmp_path / "bear_edited.ply").touch()
    press(window, "Ctrl+E", "Enter")
    press(window, "Ctrl+E")
    dialog = window.main_view.work.dialog
    assert dialog is not None
    assert dialog.text == str(tmp_path / "bear_edited-3.ply"), "one is there, one is being written"
    press(window, "Escape", "Ctrl+Q")
    dialog = window.main_view.work.dialog
    assert dialog is not None
    assert (dialog.kind, dialog.text) == ("delivery", "Scene bear_edited-2.ply")
    press(window, "Enter")
    assert not window.is_closed
    press(window, "Ctrl+Q", "S")
    for _ in range(3):
        turn(window)
    assert window.is_closed


def test_start_page_is_shown_until_a_scene_is_opened(tmp_path: Path) -> None:
    folder = bear_files(tmp_path)
    with null_app(empty(), ViewState(), folder) as app:
        assert app.main_view.at_start
        press(app, "Ctrl+N", "V")
        assert not app.main_view.work.form_open, "keys of a scene do nothing here"
        app.parts.file_actions.open(folder / "edits" / "scarf.gdf")
        assert app.main_view.work.message is not None
        assert app.main_view.work.message.text == "scarf.gdf belongs to a scene; open that first"
        app.parts.file_actions.open(folder / "bear.ply")
        turn(app)
        assert not app.main_view.at_start
        assert app.main_view.work.view.camera.distance == first_camera(app.documents.get().scene).distance
        press(app, "Ctrl+N")
        assert app.main_view.work.form_open
    assert load_thumbnail(folder / "bear.ply") is not None, "for the next start page"


def test_demo_card_counts_edits_and_each_draft_becomes_one_layer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job_queue, "Child", Trainer)
    monkeypatch.setattr(job_queue, "PROGRESS_INTERVAL_S", 0.0)
    Trainer.ended = None
    Trainer.edit = None
    files = bear_files(tmp_path)
    demo = state_folder() / "demo"
    scarf = state_folder() / "demo" / "scarf"
    with null_app(empty(), ViewState(), tmp_path) as app:
        request(app, Plain("demo"))
        (job,) = app.parts.jobs.queue.jobs
        assert job.progress.share == 0.0
        (scarf / "state").mkdir(parents=True)
        shutil.copy(files / "bear.ply", demo / "scene.ply")
        job.task.log.write_text("24000 Gaussians\n\n1 of 4: scarf: recolor:#1b6972 on scarf\nloss: L2\n")
        (scarf / "state" / "progress.json").write_text('{"share": 0.5, "label": "Training", "seconds": 9}')
        for name, strength in (("draft.gdf", 1.0), ("draft.gdf", 0.3), ("scarf.gdf", 0.3)):
            shutil.copy(files / "edits" / "scarf.gdf", scarf / name)
            for _ in range(3):
                turn(app)
            view = app.main_view.work.view
            assert [(layer.name, layer.strength) for layer in view.layers] == [("scarf", strength)]
            assert app.documents.get().gdf_paths == (scarf / name,)
            app.main_view.store.change(replace(view, layers=(replace(view.layers[0], strength=0.3),)))
        (job,) = app.parts.jobs.queue.jobs
        assert (job.progress.label, job.progress.share) == ("1 of 4: scarf", 0.0)
        Trainer.ended = 0


def test_jobs_of_another_scene_continue_and_name_their_scene(window: application.App, tmp_path: Path) -> None:
    save_ply(tmp_path / "half.ply", bear().scene[:700])
    request(window, Plain("train"))
    press(window, "Ctrl+E", "Enter")
    window.parts.file_actions.open(tmp_path / "half.ply")
    turn(window)
    job, delivery = window.main_view.work.jobs
    assert (job.status, job.elsewhere, delivery.elsewhere) == ("running", "bear.ply", "bear.ply")
    Trainer.ended = 2
    Trainer.line = "the disk is full"
    turn(window)
    turn(window)
    assert window.main_view.work.jobs == (), "what failed is the scene's"
    window.parts.file_actions.open(tmp_path / "bear.ply")
    turn(window)
    job, delivery = window.main_view.work.jobs
    assert (job.status, job.elsewhere) == ("failed", "")
    assert (delivery.status, delivery.elsewhere) == ("failed", "")


def test_edit_of_another_scene_is_rebound_from_its_message(window: application.App, tmp_path: Path) -> None:
    scarf = bear().gdfs[0]
    moved = replace(bear().scene, means=bear().scene.means + 0.001)
    foreign = tmp_path / "foreign.gdf"
    out = tmp_path / "foreign-rebound.gdf"
    save_gdf(foreign, replace(scarf, scene=fingerprint(moved)))
    save_ply(tmp_path / "moved.ply", moved)
    window.parts.file_actions.open(foreign)
    question = window.main_view.work.question
    assert question is not None
    label, action = question.buttons[0]
    assert (question.text, label) == ("foreign.gdf was made for another scene", "Rebind…")
    request(window, action)
    dialog = window.main_view.work.dialog
    assert dialog is not None
    window.main_view.messages.ask(replace(dialog, text=str(tmp_path / "moved.ply")))
    press(window, "Enter")
    turn(window)
    scenes = (f"--from={tmp_path / 'moved.ply'}", f"--to={tmp_path / 'bear.ply'}")
    assert tuple(Trainer.said) == ("rebind", str(foreign), *scenes, f"--out={out}")
    assert main([*Trainer.said]) == 0, "what is queued does it"
    Trainer.edit = None
    Trainer.ended = 0
    turn(window)
    (layer,) = window.main_view.work.view.layers
    assert layer.name == "scarf"
    assert window.main_view.work.jobs == ()


def test_saved_region_offers_a_new_edit(window: application.App) -> None:
    press(window, "Ctrl+A")
    request(window, WithText("save_region", "all of it"))
    message = window.main_view.work.message
    assert message is not None
    assert message.text == "Region 'all of it' saved"
    for _ in range(3):
        window.draw()
    bar = imgui.internal.find_window_by_name("message")
    for down in (True, False):
        imgui.get_io().add_mouse_pos_event(bar.pos.x + bar.size.x - 75.0, bar.pos.y + 20.0)
        imgui.get_io().add_mouse_button_event(0, down)
        for _ in range(3):
            window.draw()
    assert window.main_view.work.form_open
    assert window.main_view.work.message is None
