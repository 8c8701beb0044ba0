"""Grade of a new edit in the window: live while the form is open, a draft layer while it trains."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from progdf.camera import Camera
from progdf.compose import layer_paint
from progdf.field.baked import lattice_colors
from progdf.formats.cube import write_cube
from progdf.gdf.file import load_gdf, save_gdf
from progdf.io.picture_camera import camera_chunk, find_picture_camera
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import bear, first_view
from tests.viewer.app.test_studio import Trainer, request, turn
from viewer.app import app as application
from viewer.app.parts import preview
from viewer.camera.view_camera import to_camera
from viewer.files import user_files
from viewer.files.session import open_session
from viewer.jobs import job_queue, preview_process
from viewer.state.commands import OnItem, Plain
from viewer.state.forms import EDITORS, SHEET_COLUMNS, SHEET_PX, STYLE_ORDER
from viewer.state.layers import visible_layers
from viewer.state.view_state import LayerState

pytestmark = pytest.mark.gl


class Previews:
    """Stub of the preview process: it returns the same grade or picture every time."""

    grade: Path | None = None
    asked = 0

    def __init__(self, scene: Path, _: Callable[[], None]) -> None:
        self.scene = scene
        self.folder = scene.parent
        self._number = 0
        self._answers: list[preview_process.Preview] = []

    def ask(self, _: str, request: preview_process.PreviewInputs, camera: Camera) -> int:
        type(self).asked += 1
        self._number += 1
        if request.seed < 0:
            self._answers.append(
                preview_process.Preview(self._number, note="tiny on the CPU", models=("a/tiny",))
            )
            return self._number
        pixels = np.zeros((4, 4, 3), np.uint8) if self.grade is None else None
        follows = request.model != "a/tiny"
        self._answers.append(preview_process.Preview(self._number, pixels, self.grade, follows=follows))
        return self._number

    def take(self) -> preview_process.Preview | None:
        return self._answers.pop() if self._answers else None

    def close(self) -> None:
        pass


@pytest.fixture
def window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[application.App]:
    folder = bear_files(tmp_path)
    monkeypatch.setattr(job_queue, "Child", Trainer)
    monkeypatch.setattr(preview, "PreviewChild", Previews)
    monkeypatch.setattr(preview, "CAMERA_SETTLE_S", 0.0)
    Trainer.ended = None
    Trainer.line = ""
    Trainer.edit = folder / "edits" / "scarf.gdf"
    scarf = load_gdf(folder / "edits" / "scarf.gdf", bear().scene)
    save_gdf(tmp_path / "grade.gdf", replace(scarf, report={"draft": {}}))
    Previews.grade = tmp_path / "grade.gdf"
    Previews.asked = 0
    with null_app(
        replace(opened_document(folder), edits=(), gdf_paths=()), first_view(bear()), folder
    ) as app:
        yield app


def with_form(app: application.App, **changes: object) -> None:
    work = app.main_view.work
    app.main_view.store.replace(replace(work, form=replace(work.form, **changes)))  # type: ignore[arg-type]
    for _ in range(3):
        turn(app)


def opened(app: application.App, **changes: object) -> None:
    work = app.main_view.work  # set before the form opens, as the name field takes the keys then
    app.main_view.store.replace(replace(work, form=replace(work.form, name="blue")))
    press(app, "Ctrl+N")
    with_form(app, **changes)


def layer(app: application.App) -> LayerState:
    (only,) = app.main_view.work.view.layers
    return only


def test_grade_is_a_live_layer_driven_by_the_form(window: application.App) -> None:
    opened(window, strength=0.25)
    assert [live.strength for live in window.main_view.work.transient.live] == [0.25]
    assert (window.main_view.work.transient.cover, window.main_view.work.view.layers) == (None, ())
    with_form(window, strength=0.75)
    press(window, "Home", "5")
    assert [live.strength for live in visible_layers(window.main_view._displayed_view())] == [0.75]
    assert Previews.asked == 1, "neither the strength nor the camera asks for another"
    work = window.main_view.work
    selecting = replace(work.view, select=replace(work.view.select, tool="lasso"))
    window.main_view.store.replace(replace(work, view=selecting))
    assert not window.main_view._displayed_view().select.tool, "a selection would hide the colors"
    window.main_view.store.replace(work)
    with_form(window, color=(1.0, 0.0, 0.0))
    assert (Previews.asked, len(window.main_view.work.transient.live)) == (2, 1)
    with_form(window, preview=False)
    assert window.main_view.work.transient.live == ()


def test_color_drag_shows_every_grade_and_requests_the_newest_next(
    window: application.App, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested = []
    waits = []

    def ask(self: Previews, region: str, request: preview_process.PreviewInputs, _: Camera) -> int:
        self._number += 1
        requested.append(request.editor)
        waits.append((self, preview_process.Preview(self._number, grade=Previews.grade, made="grade")))
        return self._number

    def answer() -> None:
        child, made = waits.pop()
        child._answers.append(made)

    monkeypatch.setattr(Previews, "ask", ask)
    opened(window, color=(0.1, 0.0, 0.0))
    for red in (0.2, 0.3, 0.4):
        with_form(window, color=(red, 0.0, 0.0))
    assert (requested, window.main_view.work.transient.live) == (["recolor:#1a0000"], ()), "one at a time"
    answer()
    with_form(window, color=(0.5, 0.0, 0.0))
    assert requested[1:] == ["recolor:#800000"], "what was passed by meanwhile is never asked"
    assert len(window.main_view.work.transient.live) == 1, (
        "what has come is seen, though the color has moved on"
    )
    with_form(window, color=(0.1, 0.0, 0.0))  # back to the visible color while another grade is computed
    answer()
    turn(window)
    assert requested[2:] == ["recolor:#1a0000"], "the layer is that of the color that was asked for"
    shown = window.main_view.engine.gdfs[-1]
    with_form(window, region="typed", typed_region="sphere:0,0,0,9")
    answer()
    turn(window)
    assert requested[3:] == ["recolor:#1a0000"], "another region, asked for"
    assert window.main_view.engine.gdfs[-1] is shown, "of the region before nothing more is shown"


def test_manual_grade_gets_the_main_colors_of_its_region(
    window: application.App, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested = []
    gray = np.full((2, 2, 3), 0.5, np.float32)
    rows = np.arange(5)
    whole = np.ones((2, 2), np.float32)
    sample = preview_process.RegionSample(rows, gray[0], whole[0], gray, gray, whole)

    def ask(self: Previews, region: str, request: preview_process.PreviewInputs, _: Camera) -> int:
        self._number += 1
        requested.append(request.editor)
        answer = preview_process.Preview(self._number, grade=Previews.grade, made="grade")
        if request.editor == "grade":
            colors = ("#7eae44", f"#0000{self._number:02x}")
            answer = preview_process.Preview(self._number, made="palette", palette=colors, sample=sample)
        self._answers.append(answer)
        return self._number

    monkeypatch.setattr(Previews, "ask", ask)
    opened(window, editor=next(i for i, e in enumerate(EDITORS) if e.kind == "grade"))
    form = window.main_view.work.form
    assert form.palette == (("#7eae44", "#7eae44"), ("#000001", "#000001"))
    assert (requested, window.main_view.work.transient.live) == (["grade"], ())
    with_form(window, palette=(("#7eae44", "#3060d0"), form.palette[1]))
    assert requested[1:] == ["grade:#7eae44=#3060d0,#000001"]
    shown = window.engine.live
    assert shown is not None
    assert np.array_equal(shown.rows, rows)
    with_form(window, region="typed", typed_region="sphere:0,0,0,9")
    assert requested[2] == "grade"
    assert window.main_view.work.form.palette[0] == ("#7eae44", "#3060d0"), "nothing that was chosen is lost"
    with_form(window, region="all", palette=form.palette)
    assert window.main_view.work.form.palette[1][0] not in ("#000001", "#000003")
    live = window.engine.live
    count = requested.count("grade")
    work = window.main_view.work
    camera = replace(work.view.camera, azimuth=work.view.camera.azimuth + 20.0)
    window.main_view.store.replace(replace(work, view=replace(work.view, camera=camera)))
    for _ in range(3):
        turn(window)
    assert requested.count("grade") == count + 1, "the thumbnails of the looks show the new view"
    assert window.engine.live == live, "and the grade stays"
    colors = window.main_view.work.form.palette
    with_form(window, palette=())
    assert [source for source, _ in window.main_view.work.form.palette] == [source for source, _ in colors]


def test_styles_are_previewed_one_after_the_other(
    window: application.App, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: list[tuple[str, bool]] = []

    def ask(self: Previews, region: str, request: preview_process.PreviewInputs, camera: Camera) -> int:
        self._number += 1
        small = (camera.width, camera.height) == SHEET_PX
        requested.append((request.editor, small))
        pixels = np.full(
            (camera.height, camera.width, 3), 9 * int(request.editor.partition(":")[2]), np.uint8
        )
        failed = "no" if requested[-1] == ("style:3", True) else ""
        answer = preview_process.Preview(self._number, pixels if not failed else None, error=failed)
        self._answers.append(answer)
        return self._number

    monkeypatch.setattr(Previews, "ask", ask)
    opened(window, editor=next(i for i, e in enumerate(EDITORS) if e.kind == "style"))
    for _ in range(30):
        turn(window)
    order = [(f"style:{number}", True) for number in STYLE_ORDER]
    assert requested == [("style:14", False), *order], "what the form says first, then each style once"
    shown = window.main_view.work.transient.preview
    assert shown.styles == {*STYLE_ORDER} - {3}, "what cannot be painted stays a number"
    assert not shown.failed
    assert window.parts.preview._sheet is not None
    (width, height), pixels = SHEET_PX, np.frombuffer(window.parts.preview._sheet.read(alignment=1), np.uint8)
    tiles = pixels.reshape(-1, height, SHEET_COLUMNS, width, 3)[:, height // 2, :, width // 2, 0].flatten()
    expected = [0 if number == 3 else 9 * number for number in STYLE_ORDER]
    assert tiles[: len(STYLE_ORDER)].tolist() == expected, "each in its place"
    with_form(window, strength=0.5)
    assert requested[27:] == [("style:14", False)], "another strength is another picture, and the same sheet"
    work = window.main_view.work
    camera = replace(work.view.camera, azimuth=work.view.camera.azimuth + 20.0)
    window.main_view.store.replace(replace(work, view=replace(work.view, camera=camera)))
    for _ in range(3):
        turn(window)
    assert requested[28:30] == [("style:14", False), order[0]], "another view is painted anew"
    assert window.main_view.work.transient.preview.styles == shown.styles, (
        "over the last, which stays until then"
    )
    with_form(window, style=23)
    assert ("style:23", False) in requested[30:32], "and what the form says does not wait for it"


def test_preview_without_a_grade_shows_the_picture_of_the_editor(window: application.App) -> None:
    opened(window)
    Previews.grade = None
    with_form(window, editor=2)
    assert window.main_view.work.transient.cover is not None
    assert window.main_view.work.transient.live == ()


def test_preview_stays_in_its_view_until_the_edit_has_a_layer(window: application.App) -> None:
    opened(window)
    Previews.grade = None
    with_form(window, editor=2)
    preview = window.main_view.work.transient.cover
    assert preview is not None
    request(window, Plain("train"))
    transient = window.main_view.work.transient
    assert transient.cover is None
    (ghost,) = transient.covers
    assert (ghost.texture, ghost.camera, ghost.size) == (preview.texture, preview.camera, preview.size)
    assert "training" in ghost.name
    press(window, "Ctrl+N")
    with_form(window, editor=2, strength=0.5)
    covers = window.main_view.work.transient.covers
    assert [cover is ghost for cover in covers] == [False, True], "the next preview lies over it"
    window.main_view.store.replace(replace(window.main_view.work, form_open=False))
    turn(window)
    assert window.main_view.work.transient.covers == (ghost,)
    Trainer.ended = 0
    turn(window)
    assert window.main_view.work.transient.covers == ()
    assert len(window.main_view.work.view.layers) == 1


def test_picture_from_behind_ends_with_the_next_preview(window: application.App, tmp_path: Path) -> None:
    Previews.grade = None
    path = tmp_path / "behind.png"
    camera = to_camera(replace(window.main_view.work.view.camera, azimuth=160.0), 160, 120)
    Image.new("RGB", (160, 120), (10, 90, 200)).save(path, pnginfo=camera_chunk(camera))
    window.parts.preview.look_behind(path)
    turn(window)
    behind = window.main_view.work.transient.cover
    assert behind is not None
    opened(window)
    with_form(window, editor=2)
    preview = window.main_view.work.transient.cover
    assert preview is not None
    assert preview.camera == behind.camera
    window.main_view.store.replace(replace(window.main_view.work, form_open=False))
    turn(window)
    assert window.main_view.work.transient.cover is None, "its texture shows another picture now"


def test_prompt_is_painted_on_request_and_the_edit_follows_it(
    window: application.App, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = list[Path]()
    monkeypatch.setattr("viewer.app.parts.preview.open_in_program", lambda path: given.append(path) or True)
    pytest.importorskip("diffusers", reason="pip install progdf-studio[diffusion]")
    Previews.grade = None
    opened(window)
    Previews.asked = 0
    with_form(window, editor=7, sentence="make it a statue")
    state = window.main_view.work.transient.preview
    assert (state.text, state.models, state.painted) == ("tiny on the CPU", ("a/tiny",), False)
    assert (window.main_view.work.transient.cover, Previews.asked) == (None, 1), (
        "said what would paint, nothing painted"
    )
    with_form(window, asks=1)
    assert window.main_view.work.transient.cover is not None
    assert window.main_view.work.transient.cover.name == "Anchor: make it a statue"
    assert (window.main_view.work.transient.preview.painted, Previews.asked) == (True, 2)
    painted = to_camera(window.main_view.work.view.camera, 4, 4)
    press(window, "Home", "5")
    turn(window)
    assert Previews.asked == 2, "a picture takes its time: a camera that moves asks for none"
    request(window, Plain("paint_over"))
    anchor = Path(window.main_view.work.form.anchor)
    assert torch.allclose(find_picture_camera(anchor).viewmat, painted.viewmat, atol=1e-6)
    assert given == [anchor], "the program that paints pictures has it"
    assert window.main_view.work.transient.cover.name == "Anchor: make it a statue", (
        "seen until something is saved"
    )
    with Image.open(anchor) as picture:
        size = picture.size
        chunk = PngInfo()
        for key, text in picture.text.items():
            chunk.add_text(key, text)
    Image.new("RGB", size, (200, 30, 30)).save(anchor, pnginfo=chunk)
    turn(window)
    assert window.main_view.work.transient.cover.name == "Painted", "what was saved lies over the view"
    with_form(window, asks=1, model="a/tiny", anchor="")
    assert "follows no picture" in window.main_view.work.transient.preview.text
    assert not window.main_view.work.transient.preview.painted
    with_form(window, asks=1, model="", anchor=str(anchor))
    request(window, Plain("train"))
    assert f"--anchor={anchor}" in Trainer.said


def test_saved_picture_covers_a_view_larger_than_its_preview(
    window: application.App, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viewer.app.parts.preview.open_in_program", lambda path: True)
    Previews.grade = None
    opened(window)
    kind = next(i for i, choice in enumerate(EDITORS) if choice.kind == "instruct")
    with_form(window, editor=kind, sentence="make it a statue", asks=1)
    previewed = window.main_view.work.transient.cover
    assert previewed is not None
    request(window, Plain("paint_over"))
    anchor = Path(window.main_view.work.form.anchor)
    with Image.open(anchor) as picture:
        assert picture.size != previewed.size, "a preview has fewer pixels than the view"
        Image.new("RGB", picture.size, (200, 30, 30)).save(anchor)
    turn(window)
    saved = window.main_view.work.transient.cover
    assert saved is not None
    assert (saved.name, saved.camera, saved.size) == ("Painted", previewed.camera, previewed.size)


def test_banner_of_a_preview_is_below_the_comparison_bar(
    window: application.App, monkeypatch: pytest.MonkeyPatch
) -> None:
    under_bar = list[bool]()
    monkeypatch.setattr(
        "viewer.panel.pages.overlay.banner", lambda *_, **options: under_bar.append(options["under_bar"])
    )
    grade = Previews.grade
    Previews.grade = None
    opened(window, editor=2)
    assert under_bar[-1:] == [False]
    Previews.grade = grade
    with_form(window, editor=0)
    request(window, Plain("train"))
    assert layer(window).name == "blue"
    Previews.grade = None
    opened(window, editor=2)
    assert under_bar[-1:] == [True]


def test_trained_edit_replaces_its_draft_and_nothing_else(
    window: application.App,
) -> None:
    opened(window, strength=0.6)
    request(window, Plain("train"))
    assert (layer(window).name, layer(window).strength, window.main_view.work.transient.live) == (
        "blue",
        0.6,
        (),
    )
    assert window.documents.get().facts().rows[0].draft
    view = window.main_view.work.view
    count = len(window.documents.get().gdfs[0].region)
    weights = layer_paint.encode(np.linspace(0, 1, count, dtype=np.float32))
    touched = replace(layer(window), strength=0.3, paint=weights, locked=True)
    window.main_view.store.change(replace(view, layers=(touched,)))
    past = window.main_view.work.past
    before = window.engine.image(window.main_view.work.view, (32, 24))
    assert before.any()
    Trainer.ended = 0
    turn(window)
    assert (layer(window), window.main_view.work.past) == (touched, past)
    (path,) = window.documents.get().gdf_paths
    assert path.name == "blue.gdf"
    assert not window.documents.get().facts().rows[0].draft
    press(window, "Ctrl+Z")
    assert layer(window).strength == 0.6
    press(window, "Ctrl+Z", "Ctrl+Shift+Z")
    assert layer(window).name == "blue"


def test_draft_of_a_failed_training_stays_until_deleted(window: application.App) -> None:
    opened(window)
    request(window, Plain("train"))
    Trainer.ended = 2
    Trainer.line = "the disk is full"
    turn(window)
    (job,) = window.parts.jobs.queue.jobs
    request(window, OnItem("discard_run", job.number))
    assert layer(window).name == "blue"
    press(window, "Ctrl+Delete")
    assert window.main_view.work.view.layers == ()
    press(window, "Ctrl+Z")
    assert layer(window).name == "blue"


def test_deleted_draft_does_not_block_the_trained_edit(window: application.App) -> None:
    opened(window)
    request(window, Plain("train"))
    press(window, "Ctrl+Delete")
    Trainer.ended = 0
    turn(window)
    assert layer(window).name == "scarf"


def test_session_saved_with_a_draft_opens_with_the_trained_edit(
    window: application.App, tmp_path: Path
) -> None:
    opened(window, strength=0.6)
    request(window, Plain("train"))
    window.parts.file_actions.save(tmp_path / "bear.session.json")
    saved = open_session(tmp_path / "bear.session.json")
    assert [path.name for path in saved.document.gdf_paths] == ["blue.draft.gdf"]
    Trainer.ended = 0
    turn(window)
    window.parts.file_actions.open(tmp_path / "bear.session.json")
    turn(window)
    assert [path.name for path in window.documents.get().gdf_paths] == ["blue.gdf"]
    assert layer(window).strength == 0.6


def test_draft_of_the_run_becomes_the_layer_without_a_preview(window: application.App) -> None:
    opened(window, preview=False)
    request(window, Plain("train"))
    assert window.main_view.work.view.layers == ()
    (job,) = window.parts.jobs.queue.jobs
    job.task.out.mkdir(parents=True)
    (job.task.out / "draft.gdf").write_bytes((Previews.grade or Path()).read_bytes())
    turn(window)
    assert (layer(window).name, layer(window).strength) == ("blue", 1.0)
    Trainer.ended = 0
    turn(window)
    assert [path.name for path in window.documents.get().gdf_paths] == ["blue.gdf"]


def test_form_reads_the_folder_of_looks_each_time_it_opens(
    window: application.App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "looks"
    folder.mkdir()
    monkeypatch.setattr(user_files, "looks_folder", lambda: folder)
    table = lattice_colors(2).float()
    write_cube(folder / "old.cube", table, "old", "exposure=0.40")
    opened(window, editor=next(i for i, choice in enumerate(EDITORS) if choice.kind == "grade"))
    assert "old" in dict(window.main_view.work.transient.shelf.looks)
    (folder / "old.cube").rename(folder / "new.cube")
    for is_open in (False, True):
        window.main_view.store.replace(replace(window.main_view.work, form_open=is_open))
        turn(window)
    names = dict(window.main_view.work.transient.shelf.looks)
    assert ("old" in names, "new" in names) == (False, True)
