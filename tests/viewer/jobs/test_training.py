"""Form of a new edit as data, and the files of its training run."""

from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.io.atomic import state_folder
from progdf.region import Region
from tests.helpers.ui_rig import bear
from trainer.cli import train_options
from trainer.editors import EDITORS, check_new_editor
from trainer.editors.style import STYLES as TRAINED_STYLES
from trainer.options import EditorOptions
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder
from viewer.jobs import consent, training
from viewer.jobs.child import Progress
from viewer.jobs.job_queue import JobQueue
from viewer.jobs.training import EditOrder
from viewer.state.forms import (
    ALL,
    CHANGED,
    MAX_PAIRS,
    NEUTRAL,
    NO_CHANGE,
    STYLES,
    TYPED,
    NewEdit,
    OutsideSettings,
    missing_package,
    with_color,
    with_editor,
    with_picture,
    with_settings,
)
from viewer.state.forms import EDITORS as CHOICES

KINDS = [choice.kind for choice in CHOICES]


def order(folder: Path, name: str = "blue") -> EditOrder:
    scene = folder / "bear.ply"
    scene.touch()
    home = training.edits_folder(scene)
    return EditOrder(scene.resolve(), training.free_run(home, name), name, "all", "recolor:#3060d0")


def test_runs_lie_beside_the_scene_or_in_a_writable_folder(tmp_path: Path) -> None:
    scene = tmp_path / "there" / "bear.ply"
    scene.parent.mkdir()
    scene.touch()
    assert training.edits_folder(scene) == scene.parent / "bear.edits"
    scene.parent.chmod(0o555)
    try:
        elsewhere = training.edits_folder(scene)
    finally:
        scene.parent.chmod(0o755)
    assert elsewhere.parent == state_folder() / "edits"
    assert elsewhere.name.startswith("bear-")


def test_stopped_run_is_found_and_can_be_discarded(tmp_path: Path) -> None:
    edit_order = order(tmp_path)
    edit_order.save()
    assert [*training.stopped_orders(edit_order.out.parent, edit_order.scene)] == [], "it has not begun"
    (edit_order.out / "state").mkdir(parents=True)
    (edit_order.out / "state" / "run.json").write_text("{}")
    assert [*training.stopped_orders(edit_order.out.parent, edit_order.scene)] == [edit_order]
    assert [*training.stopped_orders(edit_order.out.parent, tmp_path / "other.ply")] == []
    assert order(tmp_path).out.name == "blue-2", "its name is taken"
    edit_order.discard()
    assert [*edit_order.out.parent.iterdir()] == []


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
def test_damaged_run_file_is_skipped(tmp_path: Path, damaged: bytes | None) -> None:
    edit_order = order(tmp_path)
    good = order(tmp_path, "gold")
    for kept in (edit_order, good):
        kept.save()
        (kept.out / "state").mkdir(parents=True)
        (kept.out / "state" / "run.json").write_text("{}")
    paths = edit_order.out.with_name("blue.train.json"), edit_order.out / "state" / "progress.json"
    paths[0].unlink()
    for path in paths:
        if damaged is None:
            path.mkdir()
        else:
            path.write_bytes(damaged)
    assert [*training.stopped_orders(edit_order.out.parent, edit_order.scene)] == [good]
    assert edit_order.read_progress(Progress(0.1)) == Progress(0.1)


def test_run_files_that_are_pipes_do_not_block(tmp_path: Path) -> None:
    edit_order = order(tmp_path)
    (edit_order.out / "state").mkdir(parents=True)
    (edit_order.out / "state" / "run.json").write_text("{}")
    for path in (edit_order.out.with_name("blue.train.json"), edit_order.out / "state" / "progress.json"):
        os.mkfifo(path)
    assert [*training.stopped_orders(edit_order.out.parent, edit_order.scene)] == []
    assert edit_order.read_progress(Progress(0.1)) == Progress(0.1)


def test_failed_removal_keeps_the_run_and_explains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    edit_order = order(tmp_path)
    edit_order.save()
    (edit_order.out / "state").mkdir(parents=True)
    (edit_order.out / "state" / "run.json").write_text("{}")

    def refuse(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        with pytest.raises(ProgdfError, match=r"cannot be removed \(Permission"):
            edit_order.discard()
    assert [*training.stopped_orders(edit_order.out.parent, edit_order.scene)] == [edit_order]
    elsewhere = tmp_path / "elsewhere"
    (edit_order.out / "state").rename(elsewhere)
    (edit_order.out / "state").symlink_to(elsewhere)
    with pytest.raises(ProgdfError, match="behind a link"):
        edit_order.discard()
    assert (elsewhere / "run.json").is_file()


@pytest.mark.parametrize("name", ["..", ".", "", "...", "link"])
def test_orders_of_a_third_party_claim_no_other_folder(name: str, tmp_path: Path) -> None:
    edit_order = order(tmp_path)
    edit_order.save()
    edits = edit_order.out.parent
    other = tmp_path / "other"
    for folder in (tmp_path, edits, other):
        (folder / "state").mkdir(parents=True)
        (folder / "state" / "run.json").write_text("{}")
    (edits / "link").symlink_to(other)
    edits.joinpath("blue.train.json").rename(edits / f"{name}.train.json")
    assert [*training.stopped_orders(edits, edit_order.scene)] == []


def test_finished_edit_is_never_discarded(tmp_path: Path) -> None:
    edit_order = order(tmp_path)
    edit_order.out.mkdir(parents=True)
    edit_order.result.touch()
    edit_order.discard()
    assert edit_order.result.exists()


def test_progress_and_recordings_of_the_trainer_are_read(tmp_path: Path) -> None:
    edit_order = order(tmp_path)
    scene = bear().scene
    folder = RunFolder(edit_order.out)
    assert edit_order.read_progress(Progress(0.1)) == Progress(0.1)
    assert edit_order.newest_recording() is None
    folder.state.path.mkdir(parents=True)
    log = RunLog(folder.log, quiet=True, progress=folder.progress)
    with log.steps("optimize", 10) as advance:
        advance(10, "loss to the edit 0.5")
    log.close()
    progress = edit_order.read_progress(Progress())
    assert (progress.label, progress.loss) == ("Training", "0.5")
    assert 0.0 < progress.share < 1.0, "the field is still to come"
    assert progress.seconds > 0.0, "for the question whether to discard it"
    later = Progress(0.9999, "Packing", "", 1e6)
    assert edit_order.read_progress(later) == Progress(0.9999, "Training", "0.5", 1e6), "never back"
    members = torch.tensor([1, 5])
    region = Region("blue", members, torch.zeros(len(scene)).index_fill(0, members, 1.0))
    folder.state.save("region", {"members": region.members, "score": region.score}, {"name": "blue"})
    offsets = torch.zeros(2, 14)
    offsets[:, -3:] = 0.25
    for index in range(2):
        folder.state.save("recordings", {"offsets": (offsets * index).half()}, {}, index)
    newest = edit_order.newest_recording()
    assert newest is not None
    assert newest.name.startswith("000001")
    edit = edit_order.recorded_edit(newest, scene)
    assert edit is not None
    assert torch.equal(edit.field.offsets(1.0), offsets)
    assert edit_order.recorded_edit(newest, scene[:10]) is None, "another scene"


def form(kind: str, **changes: Any) -> NewEdit:
    return replace(NewEdit(editor=KINDS.index(kind)), **changes)


def test_every_editor_of_the_form_exists_in_the_trainer() -> None:
    assert set(KINDS) <= set(EDITORS)


@pytest.mark.parametrize(
    "kind",
    [choice.kind for choice in CHOICES if choice.setting in ("color", "amount", "grade")],
)
def test_trainer_accepts_the_specs_of_the_form(kind: str) -> None:
    word, _, what = form(kind).spec.partition(":")
    assert word == kind
    if kind != "grade":  # a grade changes nothing until a slider moves
        check_new_editor(EditorOptions(f"{word}:{what}"))
    moved = form(kind, amount=0.98, through_hues=True, grade=(1.0, -0.25, *NEUTRAL[2:]))
    assert not moved.obstacle
    check_new_editor(EditorOptions(moved.spec))


def test_grade_spec_contains_the_palette_only_if_a_color_changes() -> None:
    colors = (("#7eae44", "#7eae44"), ("#b97a30", "#b97a30"))
    still = form("grade", palette=colors)
    assert (still.spec, still.obstacle) == ("grade", NO_CHANGE)
    moved = form(
        "grade", palette=(("#7eae44", "#3060d0"), colors[1]), curves=("0.30:0.20+0.70:0.80", "", "", "")
    )
    assert moved.spec == "grade:#7eae44=#3060d0,#b97a30,curve=0.30:0.20+0.70:0.80"
    check_new_editor(EditorOptions(moved.spec))
    again = with_settings(NewEdit(), moved.spec)
    assert again is not None
    assert (again.spec, again.palette) == (moved.spec, moved.palette)
    for foreign in ("#7eae4=#3060d0", "#7eae44=blue", "#", "#7eae44=#3060d0/none"):
        assert with_settings(NewEdit(), f"grade:{foreign}") is None, "a form would draw what is no color"
    for foreign in ("curve=none", "curve=0.2", "curve=0.5:0.2+0.4:0.3", "exposure=9", "tint=nan", "gamma=1"):
        assert with_settings(NewEdit(), f"grade:{foreign}") is None


def test_grade_spec_contains_the_curve_of_a_color() -> None:
    bent = form("grade", palette=(("#7eae44", "#7eae44/0.50:0.30"), ("#b97a30", "#b97a30")))
    assert bent.spec == "grade:#7eae44=#7eae44/0.50:0.30,#b97a30"
    assert not bent.obstacle
    check_new_editor(EditorOptions(bent.spec))
    again = with_settings(NewEdit(), bent.spec)
    assert again is not None
    assert again.palette == bent.palette


def test_picked_color_replaces_a_similar_palette_color() -> None:
    colors = (("#7eae44", "#3060d0"), ("#b97a30", "#b97a30"))
    alike = with_color(form("grade", palette=colors, picks=True), "#7fad44")
    assert alike.palette == (("#7fad44", "#3060d0"), colors[1])
    assert (alike.picks, alike.picked) == (False, 0)
    other = with_color(form("grade", palette=colors), "#c01830")
    assert other.palette == (*colors, ("#c01830", "#c01830"))
    assert other.picked == 2
    many = form("grade", palette=tuple((f"#{i:02x}0000", "#ffffff") for i in range(30, 250, 28)))
    assert len(with_color(many, "#20c0f0").palette) == MAX_PAIRS


def test_form_and_trainer_have_the_same_number_of_styles() -> None:
    assert TRAINED_STYLES == STYLES


def test_editor_reports_what_is_missing_before_training() -> None:
    assert "Describe the edit" in form("instruct").obstacle or "pip install" in form("instruct").obstacle
    assert "slider" in form("grade").obstacle
    assert form("grade", grade=(1.0, -0.25, *NEUTRAL[2:])).spec == "grade:exposure=1.00,contrast=-0.25"
    assert "folder" in form("folder").obstacle
    assert form("folder", folder="edited").obstacle == ""
    assert "pictures" in form("pictures").obstacle
    assert form("pictures", pictures="/a.png, /b.png").spec == "pictures:/a.png,/b.png"
    assert "region" in form("recolor", region=TYPED).obstacle
    unknown = replace(CHOICES[0], package="no_such_package_at_all", extra="more")
    assert missing_package(unknown) == "Recolor needs the extra 'more'; pip install 'progdf-studio[more]'"


def test_pictures_editor_finds_its_region_by_default() -> None:
    found = with_editor(NewEdit(), KINDS.index("pictures"))
    assert found.region == CHANGED
    assert with_editor(found, 0).region == ALL
    assert with_editor(NewEdit(region="hands"), KINDS.index("pictures")).region == "hands"


def test_dropped_pictures_are_added_to_the_form() -> None:
    first = with_picture(form("recolor", region="hands", pictures="old.png"), Path("a/helmet.png"), True)
    assert (first.spec, first.region) == (f"pictures:{Path.cwd()}/a/helmet.png", CHANGED)
    assert first.layer_name == "helmet"
    second = with_picture(replace(first, region="hands"), Path("b.png"), True)
    assert (second.pictures, second.region) == ("a/helmet.png, b.png", "hands")
    assert with_picture(second, Path("b.png"), True).pictures == second.pictures
    assert with_picture(second, Path("c.png"), False).pictures == "c.png"


def test_layer_name_is_a_valid_file_name() -> None:
    assert form("recolor").layer_name == "recolor"
    assert form("recolor", region="hands").layer_name == "hands recolor"
    assert form("night", name=" ../a\\b ").layer_name == "-a-b"
    assert form("style", style=7).layer_name == "style 7"
    assert form("instruct", sentence="turn him into a marble statue").layer_name == "turn him into a marble"
    assert form("instruct", sentence="make it of").layer_name == "make it of"


def test_orders_of_servers_and_programs_are_parsed_by_the_trainer() -> None:
    outside = OutsideSettings(
        "https://api.example.org/v1", "m", "http://127.0.0.1:8188", "/a/b.json", "x {input} {output}", "0.1"
    )
    for kind in ("api", "comfy", "command"):
        some = form(kind, sentence="make it gold", outside=outside)
        assert some.obstacle in ("", missing_package(some.choice))
        order = EditOrder(
            Path("a.ply"), Path("out/x"), "x", "all", some.spec,
            model=some.model_option, api_url=some.url, prompt=some.prompt,
        )  # fmt: skip
        options = train_options(order.arguments()[1:]).editor
        assert options.editor == some.spec
        assert (options.api_url, options.model, options.prompt) == (some.url, some.model_option, some.prompt)
        assert options.yes == bool(some.url)


def test_form_states_where_pictures_go_and_what_they_cost() -> None:
    outside = OutsideSettings(
        "https://api.example.org/v1", "m", price="0.04", program="/bin/x {input} {output}"
    )
    served = form("api", sentence="make it gold", outside=outside)
    assert served.outside_note == "12 pictures or more go to api.example.org, about 0.48"
    assert replace(served, outside=replace(outside, price="x")).outside_note.endswith("api.example.org")
    assert form("command", outside=outside).outside_note == "x runs on this machine, for 12 pictures or more"
    assert form("recolor").outside_note == ""
    for changes in ({"server": ""}, {"server": "ttp://x/v1"}, {"server": "http://["}, {"model": ""}):
        assert replace(served, outside=replace(outside, **changes)).obstacle.startswith("Enter the")
    assert form("command").obstacle == "Enter a program with {input} and {output}"
    assert form("comfy").obstacle.startswith("Enter the file of a workflow")


@pytest.mark.parametrize(
    ("editor", "url"),
    [
        ("command:touch /tmp/pwned {input} {output}", ""),
        ('api:"marble"', "https://api.example.org/v1"),
        ("comfy:/a/b.json", "http://127.0.0.1:8188"),
    ],
)
def test_order_of_a_file_starts_nothing_outside_without_consent(
    editor: str, url: str, tmp_path: Path
) -> None:
    stopped = replace(order(tmp_path), editor=editor, api_url=url)
    stopped.save()
    (stopped.out / "state").mkdir(parents=True)
    (stopped.out / "state" / "run.json").write_text("{}")
    queue = JobQueue()
    (found,) = training.stopped_orders(stopped.out.parent, stopped.scene)
    queue.add_stopped(found)
    (job,) = queue.jobs
    with pytest.raises(ProgdfError, match="not allowed yet"):
        queue.resume(job.number)
    with pytest.raises(ProgdfError, match="not allowed yet"):
        queue.add(replace(found, out=found.out.with_name("other")))
    assert [job.status for job in queue.jobs] == ["stopped"]
    action = consent.outside_action(editor, url)
    consent.allow(action)
    consent.check_allowed(editor, url)
    with pytest.raises(ProgdfError, match="not allowed yet"):
        consent.check_allowed(f"{editor} ", f"{url}/x")
    queue.close()


def test_consent_to_a_local_file_does_not_hold_in_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = ("command:./edit {input} {output}", "command:python edit.py {input} --lut=edit.py {output}")
    comfy = "comfy:edit.py"
    for name in ("mine", "stranger"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "edit.py").touch()
        (tmp_path / name / "edit").touch()
    monkeypatch.chdir(tmp_path / "mine")
    for editor in (*commands, comfy):
        consent.allow(consent.outside_action(editor, ""))
        consent.check_allowed(editor, "")
    assert str(tmp_path / "mine") in consent.outside_action(commands[0], "")
    monkeypatch.chdir(tmp_path / "stranger")
    for editor in (*commands, comfy):
        with pytest.raises(ProgdfError, match="not allowed yet"):
            consent.check_allowed(editor, "")


def test_order_arguments_are_parsed_by_the_trainer() -> None:
    order = EditOrder(Path("a b.ply"), Path("out/-x"), "-x", "all-sphere:0,0,0,1", "night:0.70", True, 1)
    options = train_options(order.arguments(resumes=True)[1:])
    assert (options.scene, options.out, options.name) == (order.scene, order.out, order.name)
    assert (options.region.region, options.editor.editor) == (order.region, order.editor)
    assert options.quick
    assert options.resume
    assert options.threads == 1


@pytest.mark.parametrize(
    "spec",
    [
        *("recolor:#1b6972", "recolor:#1b6972,path=hue", "tint:#4f6fd8", "stripes:#ffffff", "darken:0.30"),
        *("night:0.95", "grade:exposure=0.70,whites=0.80", "style:23", "instruct:make it gold, please"),
        *("pictures:/a/b.png,/a/c.png", "folder:/a/views", "api:make it gold", "comfy:/a/b.json"),
        "command:magick {input} -modulate 100,{100..30} {output}",
    ],
)
def test_form_is_filled_from_the_instruction_of_an_edit(spec: str) -> None:
    form = with_settings(NewEdit(sentence="x", color=(1.0, 0.0, 0.0)), spec)
    assert form is not None
    assert form.spec == spec
