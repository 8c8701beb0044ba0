"""Test of the color brush and the clone stamp in the window."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from imgui_bundle import imgui
from PIL import Image

from progdf.errors import ProgdfError
from progdf.formats.scene_file import save_scene
from progdf.gaussians import Gaussians
from progdf.gdf.file import save_gdf
from progdf.io.picture_camera import find_picture_camera, layers_in_picture
from progdf.painting.projection import fitted_surface, quick_surface, view_surface
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from tests.trainer.painted_wall import CAMERA as WALL_CAMERA
from tests.trainer.painted_wall import wall
from viewer.app.messages import Messages
from viewer.app.parts.painting import PaintingActions
from viewer.camera.view_camera import ViewCamera, to_camera
from viewer.files.document import Document, DocumentStore
from viewer.files.document import load as load_document
from viewer.files.session import WindowSession, open_session, save
from viewer.jobs.job_queue import JobQueue, QueuedTask
from viewer.jobs.training import EditOrder
from viewer.render.engine import ViewEngine
from viewer.render.paint_overlay import _fit_worker, packed_picture, pixels_of
from viewer.state.actions import perform
from viewer.state.commands import Plain
from viewer.state.transient import CloneSource, PendingPaint
from viewer.state.view_state import ColorBrush, LayerState, PaintedPicture, ViewState
from viewer.state.workspace import JobStatus, Store, new_workspace, record_undo, with_transient

START = (170.0, 260.0)
END = (230.0, 260.0)
RED = (1.0, 0.0, 0.0)


@pytest.fixture
def hand() -> Iterator[Rig]:
    """Return a window on the bear with the color brush active."""
    with rig(painting(ColorBrush("color", radius=12.0, hardness=1.0, color=RED))) as opened:
        yield opened


def painting(brush: ColorBrush) -> ViewState:
    return replace(first_view(bear()), color_brush=brush)


def painted(hand: Rig) -> tuple[PaintedPicture, ...]:
    return hand.main_view.work.view.painted


def test_stroke_paints_the_surface(hand: Rig) -> None:
    hand.drag(START, END)
    (picture,) = painted(hand)
    pixels = pixels_of(picture)
    assert pixels[260, 200].tolist() == [255, 0, 0, 255]
    assert not pixels[200, 200, 3], "beside the stroke"
    hand.move(400.0, 40.0)
    hand.settle()
    assert hand.image()[260, 200].tolist() == [255, 0, 0]


def test_stroke_begins_while_a_training_is_shown(hand: Rig) -> None:
    view = hand.main_view
    edits = bear().gdfs
    engine = ViewEngine(view.context, bear().scene, (*edits, replace(edits[0], name="training")), "cpu")
    view.set_engine(engine, view.facts, (LayerState(len(edits), "training", 0.01),))
    hand.settle()
    hand.drag(START, END)
    assert len(painted(hand)) == 1
    engine.release()


def test_stroke_beside_the_scene_paints_nothing(hand: Rig) -> None:
    hand.drag((70.0, 150.0), (85.0, 160.0))
    assert painted(hand) == ()
    message = hand.main_view.work.message
    assert message is not None
    assert message.text == "Nothing was painted: there is no surface under the brush"


def test_undo_and_redo_go_stroke_by_stroke(hand: Rig) -> None:
    hand.drag(START, END)
    first = painted(hand)
    hand.drag((200.0, 300.0), (230.0, 300.0))
    second = painted(hand)
    assert len(second) == 1, "both strokes are in one view"
    hand.key("Ctrl+Z")
    assert painted(hand) == first
    hand.key("Ctrl+Z")
    assert painted(hand) == ()
    hand.key("Ctrl+Y")
    hand.key("Ctrl+Y")
    assert painted(hand) == second


def test_escape_cancels_a_stroke(hand: Rig) -> None:
    hand.move(*START)
    hand.press()
    hand.move(*END)
    hand.key("Escape")
    hand.release()
    assert painted(hand) == ()
    assert hand.main_view.work.view.color_brush.tool == "color"


def test_eraser_removes_paint_of_every_view(hand: Rig) -> None:
    hand.drag(START, END)
    turned = replace(hand.main_view.work.view.camera, azimuth=hand.main_view.work.view.camera.azimuth + 12.0)
    hand.main_view.store.change(replace(hand.main_view.work.view, camera=turned))
    hand.settle()
    hand.key("X")
    for _ in range(5):
        hand.key("]")
    assert hand.main_view.work.view.color_brush.erases
    before = pixels_of(painted(hand)[0])[..., 3].sum()
    hand.drag((60.0, 240.0), (330.0, 270.0))
    after = sum(int(pixels_of(one)[..., 3].sum()) for one in painted(hand))
    assert after < 0.2 * before


def test_paint_stays_on_the_surface_in_another_view(hand: Rig) -> None:
    hand.drag(START, END)
    turned = replace(hand.main_view.work.view.camera, azimuth=hand.main_view.work.view.camera.azimuth + 20.0)
    hand.main_view.store.change(replace(hand.main_view.work.view, camera=turned))
    hand.rest()
    image = hand.image()[:, :340].astype(int)
    red = (image[..., 0] > 200) & (image[..., 1] < 60) & (image[..., 2] < 60)
    assert red.sum() > 600
    rows = np.nonzero(red)[0]
    assert abs(np.median(rows) - 260) < 20


def test_second_view_covers_the_first(hand: Rig) -> None:
    hand.drag(START, END)
    view = hand.main_view.work.view
    blue = replace(view.color_brush, color=(0.0, 0.0, 1.0), radius=40.0)
    turned = replace(view.camera, azimuth=view.camera.azimuth + 8.0)
    hand.main_view.store.change(replace(view, camera=turned, color_brush=blue))
    hand.rest()
    hand.drag((100.0, 255.0), (300.0, 262.0))
    hand.rest()
    assert len(painted(hand)) <= 2
    image = hand.image()[240:280, 150:250].astype(int)
    red = (image[..., 0] > 200) & (image[..., 2] < 60)
    assert red.sum() < 20


def test_alt_click_takes_the_color(hand: Rig) -> None:
    wanted = hand.image()[300, 200]
    hand.modifier(imgui.Key.mod_alt)
    hand.click(200.0, 300.0)
    hand.modifier(imgui.Key.mod_alt, False)
    color = np.array(hand.main_view.work.view.color_brush.color)
    assert np.abs(255.0 * color - wanted).max() <= 3
    assert painted(hand) == ()


def test_clone_stamp_copies_from_its_source() -> None:
    with rig(painting(ColorBrush("clone", radius=10.0, hardness=1.0))) as hand:
        hand.click(*START)
        message = hand.main_view.work.message
        assert message is not None
        assert "Alt+click" in message.text
        hand.modifier(imgui.Key.mod_alt)
        hand.click(150.0, 300.0)
        hand.modifier(imgui.Key.mod_alt, False)
        assert hand.main_view.work.transient.clone is not None
        original = hand.main_view.original_picture()
        hand.drag((200.0, 260.0), (220.0, 260.0))
        source = hand.main_view.work.transient.clone
        assert source is not None
        assert source.offset is not None
        x = round(source.offset[0])
        y = round(source.offset[1])
        pixels = pixels_of(painted(hand)[0])
        copied = original[260 + y, 210 + x].astype(int)
        assert np.abs(pixels[260, 210, :3].astype(int) - copied).max() <= 2


def test_clone_stamp_copies_no_background() -> None:
    with rig(painting(ColorBrush("clone", radius=10.0, hardness=1.0))) as hand:
        work = hand.main_view.work
        camera = to_camera(work.view.camera, *hand.main_view.picture_size)
        K = camera.K.double().numpy()
        ray = np.array([(20.0 - K[0, 2]) / K[0, 0], (150.0 - K[1, 2]) / K[1, 1], 1.0])
        beside = camera.c2w.double().numpy() @ np.array([*(3.0 * ray), 1.0])
        source = CloneSource((float(beside[0]), float(beside[1]), float(beside[2])))
        hand.main_view.store.replace(with_transient(work, clone=source))
        hand.drag((200.0, 260.0), (210.0, 260.0))
        assert painted(hand) == ()
        message = hand.main_view.work.message
        assert message is not None
        assert message.text.startswith("Nothing was painted")


def test_comparison_refuses_strokes(hand: Rig) -> None:
    hand.key("Y")
    hand.drag(START, END)
    assert painted(hand) == ()
    message = hand.main_view.work.message
    assert message is not None
    assert message.text.startswith("Cannot paint: two pictures are compared")


def test_keys_change_size_and_hardness(hand: Rig) -> None:
    hand.key("]")
    hand.key("Shift+]")
    brush = hand.main_view.work.view.color_brush
    assert (brush.radius, brush.hardness) == (15.0, 0.9)
    hand.key("Escape")
    assert hand.main_view.work.view.color_brush.tool == ""


def test_discarded_paint_comes_back_by_undo(hand: Rig) -> None:
    hand.drag(START, END)
    before = painted(hand)
    work = hand.main_view.work
    facts = hand.main_view.facts
    hand.main_view.store.replace(record_undo(perform(work, Plain("discard_paint"), facts)))
    assert painted(hand) == ()
    hand.key("Ctrl+Z")
    assert painted(hand) == before


def test_paint_tools_and_other_tools_exclude_each_other(hand: Rig) -> None:
    hand.key("Alt+C")
    assert hand.main_view.work.view.color_brush.tool == "clone"
    hand.key("R")
    view = hand.main_view.work.view
    assert (view.color_brush.tool, view.select.tool) == ("", "box")
    hand.key("Alt+B")
    view = hand.main_view.work.view
    assert (view.color_brush.tool, view.select.tool) == ("color", "")


@dataclass
class Jobs:
    """Queue that starts nothing."""

    jobs: tuple[QueuedTask, ...] = ()

    def add(self, order: EditOrder) -> None:
        self.jobs = (*self.jobs, QueuedTask(1, order))

    def end(self, status: JobStatus) -> None:
        self.jobs = (replace(self.jobs[0], status=status),)


@dataclass
class Easel:
    """Part for paint with its collaborators."""

    part: PaintingActions
    store: Store
    jobs: Jobs
    documents: DocumentStore

    @property
    def pending(self) -> tuple[PendingPaint, ...]:
        return self.store.get().transient.pending


@pytest.fixture
def easel(tmp_path: Path) -> Easel:
    return make_easel(tmp_path)


def make_easel(folder: Path, layers: tuple[LayerState, ...] = ()) -> Easel:
    """Return the part with paint in two views. All layers have the edit blue.gdf."""
    edits = bear().gdfs[:1]
    save_gdf(folder / "blue.gdf", edits[0])
    files = (folder / "blue.gdf",)
    document = Document("bear.ply", bear().scene, edits, folder / "bear.ply", files)
    view = replace(painting(ColorBrush("color")), layers=layers)
    pixels = np.zeros((40, 60, 4), np.uint8)
    pixels[10:20, 5:30] = (10, 20, 30, 255)
    turned = replace(view.camera, azimuth=view.camera.azimuth + 30.0)
    pictures = tuple(packed_picture(camera, (60, 40), pixels) for camera in (view.camera, turned))
    store = Store(new_workspace(replace(view, painted=pictures)))
    jobs = Jobs()
    documents = DocumentStore(document, lambda *_: None)
    part = PaintingActions(
        store=store,
        documents=documents,
        messages=Messages(store, lambda: 0.0),
        queue=cast(JobQueue, jobs),
    )
    return Easel(part, store, jobs, documents)


def test_done_writes_the_paint_with_its_cameras_and_queues_a_run(easel: Easel) -> None:
    before = easel.store.get().view.painted
    easel.part.requests["finish_paint"](None)
    order = easel.jobs.jobs[0].task
    assert isinstance(order, EditOrder)
    files = [Path(name) for name in order.editor.removeprefix("paint:").split(",")]
    assert [path.name for path in files] == ["paint.view-1.png", "paint.view-2.png"]
    for path, picture in zip(files, before, strict=True):
        assert np.array_equal(np.asarray(Image.open(path)), pixels_of(picture))
        assert find_picture_camera(path).width == 60
    view = easel.store.get().view
    assert (view.painted, view.color_brush.tool) == ((), "")
    assert [paint.painted for paint in easel.pending] == [before]


def test_done_names_the_layers_below_the_paint(tmp_path: Path) -> None:
    bench = make_easel(tmp_path, (LayerState(0, "blue", 0.5), LayerState(1, "hidden", 1.0, False)))
    bench.part.requests["finish_paint"](None)
    order = bench.jobs.jobs[0].task
    assert isinstance(order, EditOrder)
    for name in order.editor.removeprefix("paint:").split(","):
        layers = layers_in_picture(name)
        assert layers is not None
        assert str(layers) == "blue 0.5"
        assert layers.layers[0].file == "blue.gdf"


def test_done_over_a_layer_without_a_file_keeps_the_paint(tmp_path: Path) -> None:
    bench = make_easel(tmp_path, (LayerState(7, "training", 1.0),))
    before = bench.store.get().view.painted
    with pytest.raises(ProgdfError, match="training has no file yet; hide it"):
        bench.part.requests["finish_paint"](None)
    assert bench.store.get().view.painted == before
    assert not bench.jobs.jobs


def test_paint_stays_until_its_layer_is_ready(easel: Easel) -> None:
    easel.part.requests["finish_paint"](None)
    assert easel.part.poll() is not None
    assert easel.pending
    easel.jobs.end("done")
    assert easel.part.poll() is None
    assert not easel.pending
    assert easel.store.get().view.painted == ()


@pytest.mark.parametrize("status", ["failed", None])
def test_paint_of_a_failed_or_discarded_run_comes_back(easel: Easel, status: JobStatus | None) -> None:
    before = easel.store.get().view.painted
    easel.part.requests["finish_paint"](None)
    if status is None:
        easel.jobs.jobs = ()
    else:
        easel.jobs.end(status)
    easel.part.poll()
    assert easel.store.get().view.painted == before
    assert not easel.pending


def test_failed_paint_waits_for_its_scene(easel: Easel) -> None:
    before = easel.store.get().view.painted
    own = easel.documents.get()
    easel.part.requests["finish_paint"](None)
    easel.documents.replace(replace(own, path=own.file.with_name("other.ply")))
    easel.store.replace(with_transient(easel.store.get(), pending=()))
    easel.jobs.end("failed")
    easel.part.poll()
    assert easel.store.get().view.painted == ()
    assert easel.pending == ()
    easel.documents.replace(own)
    easel.part.poll()
    assert easel.store.get().view.painted == before


def test_done_without_paint_is_refused(easel: Easel) -> None:
    easel.store.change(replace(easel.store.get().view, painted=()))
    with pytest.raises(ProgdfError, match="nothing is painted"):
        easel.part.requests["finish_paint"](None)


def test_quick_surface_is_near_the_model_and_smoother_than_the_depth() -> None:
    scene = wall()
    seen = view_surface(scene, WALL_CAMERA)
    painted = np.zeros(seen.depth.shape, bool)
    painted[40:90, 40:90] = True
    focal = float(WALL_CAMERA.K[0, 0])
    plain = fitted_surface(scene, seen, painted).depth[painted]
    quick = quick_surface(seen, painted).depth[painted]
    assert np.abs(quick / plain - 1.0).max() * focal < 1.0
    assert np.abs(seen.depth[painted] / plain - 1.0).max() * focal > 1.5


def test_session_keeps_paint(tmp_path: Path) -> None:
    scene = tmp_path / "bear.ply"
    save_scene(scene, bear().scene)
    pixels = np.zeros((40, 60, 4), np.uint8)
    pixels[10:20, 5:30] = (10, 20, 30, 255)
    picture = packed_picture(ViewCamera(), (60, 40), pixels)
    opened = load_document(scene)
    path = tmp_path / "bear.session.json"
    view = replace(painting(ColorBrush("color")), painted=(picture,))
    save(path, WindowSession(opened, view))
    again = open_session(path).view
    assert again.painted == (picture,)
    assert again.color_brush.tool == ""
    damaged = replace(picture, pixels=b"none")
    save(path, WindowSession(opened, replace(view, painted=(damaged,))))
    with pytest.raises(ProgdfError, match="a painted picture is damaged"):
        open_session(path)


def test_model_of_the_surface_replaces_the_depth_of_a_view(hand: Rig) -> None:
    hand.drag(START, END)
    (picture,) = painted(hand)
    view = hand.main_view
    pointer = view.pointer()
    fits = view.paint.fits
    fits.drop()
    seen = pointer.view_surface(picture.camera, picture.size)
    model = replace(seen, depth=1.01 * seen.depth, is_model=True)
    quick = pointer.paint_surface(picture)
    fits.request(pointer.scene_key, picture, lambda: model)
    _fit_worker().submit(int).result()
    assert not fits.is_busy
    assert pointer.paint_surface(picture) is model
    pixels = pixels_of(picture).copy()
    pixels[300:310, 200:220] = 255
    later = pointer.paint_surface(packed_picture(picture.camera, picture.size, pixels))
    assert later.depth[260, 200] == model.depth[260, 200], "earlier strokes keep their model"
    fits.drop()
    assert pointer.paint_surface(picture) is quick


@pytest.mark.slow
def test_model_of_a_flat_surface_is_flat() -> None:
    random = np.random.default_rng(0)
    count = 4000
    means = np.column_stack([random.uniform(-1.5, 1.5, (count, 2)), 0.03 * random.standard_normal(count)])
    scene = Gaussians(
        torch.tensor(means, dtype=torch.float32),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.full((count, 3), -2.7),
        torch.full((count,), 3.0),
        torch.zeros(count, 3),
        torch.zeros(count, 0, 3),
    )
    camera = to_camera(ViewCamera(distance=3.0, elevation=0.0), 96, 96)
    seen = view_surface(scene, camera)
    assert np.isfinite(seen.depth[30:66, 30:66]).all()
    painted = np.zeros((96, 96), bool)
    painted[34:62, 34:62] = True
    model = fitted_surface(scene, seen, painted)
    assert model.is_model
    assert np.ptp(model.depth[34:62, 34:62]) < 0.5 * np.ptp(seen.depth[34:62, 34:62])
