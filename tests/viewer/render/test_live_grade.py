"""Live grade of the form: exact in the view, the lattice of many colors, histogram, clipping marks, looks."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.color.clarity import local_detail
from progdf.color.grade import ColorGrade, grade_course, grade_fully, parse_grade
from progdf.color.looks import BUILT_IN
from progdf.field.baked import lattice_colors
from progdf.field.grade import look_up
from progdf.formats.cube import SIDE as CUBE_SIDE
from progdf.formats.cube import read_cube, read_settings, write_cube
from progdf.rasterize import activate
from progdf.rasterize.cpu.pyramid import Pyramid
from progdf.sh import basis
from tests.helpers.ui_rig import bear
from viewer.camera.view_camera import first_camera, to_camera
from viewer.files import user_files
from viewer.jobs.preview_process import RegionSample
from viewer.render import dynamic_resolution, live_grade
from viewer.render.dynamic_resolution import LiveScene, MovingGrade
from viewer.render.engine import ViewEngine
from viewer.render.live_grade import (
    BLACK_MARK,
    WHITE_MARK,
    ColorTable,
    FormGrader,
    LiveColors,
    LiveGrade,
    drawn_colors,
)
from viewer.state.forms import EDITORS, NewEdit, with_look
from viewer.state.view_state import ViewState

GRADE = parse_grade("exposure=0.4,shadows=0.5,temperature=0.3,wheel_shadows=250:0.3:0")
FORM = NewEdit(editor=next(i for i, editor in enumerate(EDITORS) if editor.kind == "grade"))


def with_lobes(degree: int = 2):  # type: ignore[no-untyped-def]
    scene = bear().scene
    generator = torch.Generator().manual_seed(0)
    shN = 0.1 * torch.randn(len(scene), (degree + 1) ** 2 - 1, 3, generator=generator)
    return replace(scene, shN=shN)


def sample_of(colors: torch.Tensor) -> RegionSample:
    picture = colors[:12].reshape(3, 4, 3).numpy()
    return RegionSample(
        np.arange(len(colors)),
        colors.numpy(),
        np.ones(len(colors), np.float32),
        picture,
        picture,
        np.ones((3, 4), np.float32),
    )


def test_live_grade_is_exact_in_the_current_view() -> None:
    scene = with_lobes()
    camera = to_camera(first_camera(scene), 64, 48)
    rows = np.arange(0, len(scene), 2)
    graded = LiveColors().apply(scene, LiveGrade(rows, GRADE), camera, 0)
    kept = torch.from_numpy(rows)
    before = drawn_colors(scene, kept, camera.position)
    after = drawn_colors(graded, kept, camera.position)
    assert torch.allclose(after.clamp_min(0.0), grade_fully(before, GRADE), atol=1e-4)
    others = torch.arange(1, len(scene), 2)
    assert torch.equal(graded.sh0[others], scene.sh0[others])
    assert graded.shN is scene.shN


def test_lattice_of_used_points_equals_the_whole_lattice(monkeypatch: pytest.MonkeyPatch) -> None:
    colors = torch.rand(3000, 3, generator=torch.Generator().manual_seed(1)) ** 2
    live = LiveGrade(np.arange(len(colors)), GRADE)
    exact = ColorTable(colors).apply(live)
    monkeypatch.setattr(live_grade, "SIDE", 9)
    few = ColorTable(colors).apply(LiveGrade(live.rows, GRADE))
    table = grade_fully(lattice_colors(9).float(), GRADE)
    assert torch.allclose(few, look_up(colors.T, table).T, atol=1e-6)
    assert (few - exact).abs().mean() < 0.02


def test_engine_shows_the_live_grade_and_returns_to_the_scene() -> None:
    scene = bear().scene
    view = ViewState(camera=first_camera(scene))
    engine = ViewEngine(None, scene)

    def picture() -> np.ndarray:
        engine.timings = engine._update_picture(view, to_camera(view.camera, 64, 48), live=engine.live)
        return np.array(engine.renderer.pixels())

    before = picture()
    engine.live = LiveGrade(np.arange(len(scene)), GRADE)
    assert engine.needs_draw(view, (64, 48))
    graded = picture()
    assert np.abs(graded - before).max() > 0.1
    assert np.array_equal(engine.image(view, (64, 48)), before), "pictures to save have no live grade"
    assert np.array_equal(picture(), graded)
    engine.live = None
    assert np.array_equal(picture(), before)


def test_live_clarity_is_that_of_the_editor(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = with_lobes()
    camera = to_camera(first_camera(scene), 64, 48)
    rows = np.arange(len(scene))
    grade = parse_grade("exposure=0.4,clarity=0.8")
    graded = LiveColors().apply(scene, LiveGrade(rows, grade), camera, 0)
    kept = torch.from_numpy(rows)
    detail = local_detail(scene, kept)
    before = drawn_colors(scene, kept, camera.position)
    after = drawn_colors(graded, kept, camera.position)
    expected = grade_fully(before, grade, detail)
    assert torch.allclose(after.clamp_min(0.0), expected, atol=1e-4)
    assert (expected - grade_fully(before, grade)).abs().max() > 0.02
    monkeypatch.setattr(live_grade, "SIDE", 17)
    few = ColorTable(before.clamp(0, 1)).apply(LiveGrade(rows, grade), detail)
    assert (few - expected).abs().mean() < 0.02


def test_shares_of_rows_in_the_pyramid_follow_the_tree() -> None:
    scene = bear().scene
    pyramid = Pyramid(activate(scene))
    total = len(pyramid.nodes.means)
    rows = np.flatnonzero(scene.means[:, 0].numpy() > 0.0)
    shares = pyramid.means_of(np.isin(np.arange(len(scene)), rows).astype(np.float32))
    assert shares.shape == (total + len(scene),)
    assert set(np.flatnonzero(shares[::-1][: len(scene)])) == set(rows), "a pick ~row indexes from the end"
    nodes = shares[:total]
    assert ((nodes >= 0.0) & (nodes <= 1.0)).all()
    for parent in range(total // 2):
        children = nodes[2 * parent + 1 : 2 * parent + 3]
        assert children.min() - 1e-6 <= nodes[parent] <= children.max() + 1e-6
    everything = pyramid.means_of(np.ones(len(scene), np.float32))
    assert everything == pytest.approx(1.0)


def test_pictures_in_motion_have_the_grade_and_leave_the_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dynamic_resolution, "MOVING_MS", (0.0, np.inf))  # the same detail in each picture
    monkeypatch.setattr(dynamic_resolution, "FINE_MS", (0.0, np.inf))
    scene = with_lobes()
    camera = to_camera(first_camera(scene), 64, 48)
    rows = np.flatnonzero(scene.means[:, 0].numpy() > 0.0)
    live = LiveScene(scene)
    pyramid = live.begin_pyramid().result()
    before = live.drawn.colors.clone()
    plain = live.draw_fewer(lambda fewer: fewer.colors.clone(), camera, 2)
    colors = LiveColors()
    grade = LiveGrade(rows, GRADE)
    live.moving_grade = MovingGrade(rows, partial(colors.recolor, grade))
    graded = live.draw_fewer(lambda fewer: fewer.colors.clone(), camera, 2)
    assert plain is not None
    assert graded is not None
    values = np.isin(np.arange(len(scene)), rows).astype(np.float32)
    share = torch.from_numpy(pyramid.means_of(values)[pyramid.picks])
    exact = torch.lerp(plain, grade_fully(plain, GRADE), share[:, None])
    assert torch.allclose(graded, exact, atol=0.02), "as of the lattice"
    assert torch.equal(graded[share == 0.0], plain[share == 0.0])
    assert torch.equal(live.drawn.colors, before)
    full = colors.apply(scene, grade, camera, 0)
    live.show_grade(full, rows)
    held = live.drawn.colors.clone()
    assert not torch.equal(held, before)
    live.draw_fewer(lambda fewer: None, camera, 2)
    assert torch.equal(live.drawn.colors, before), "the pyramid reads the colors of the scene"
    live.begin_full()
    assert torch.equal(live.drawn.colors, held)
    live.show_grade(None, rows)
    assert torch.equal(live.drawn.colors, before)


@pytest.mark.parametrize("every", [1, 3])
def test_colors_of_all_rows_equal_those_of_single_ones(every: int) -> None:
    scene = with_lobes(3)
    rows = torch.arange(5, len(scene), every)
    position = torch.tensor([0.0, 1.0, -4.0])
    colors = drawn_colors(scene, rows, position)
    directions = torch.nn.functional.normalize(scene.means[rows] - position, dim=1)
    expected = torch.einsum("mb,mbc->mc", basis(3, directions), scene.sh[rows]) + 0.5
    assert torch.allclose(colors, expected, atol=1e-5)


def test_clipped_colors_are_marked_and_counted() -> None:
    colors = torch.tensor([[1.0, 0.5, 0.2], [0.0, 0.0, 0.0], [0.4, 0.5, 0.6], [0.2, 0.0, 0.3]]).repeat(4, 1)
    marked = ColorTable(colors).apply(LiveGrade(np.arange(16), ColorGrade(), marks=True))
    assert marked[0].tolist() == pytest.approx(WHITE_MARK)
    assert marked[1].tolist() == pytest.approx(BLACK_MARK)
    assert torch.equal(marked[2:4], colors[2:4])
    grader = FormGrader()
    assert not grader.scope(None).bins
    grader.sample = sample_of(colors)
    scope = grader.scope(None)
    assert (scope.white, scope.black) == (0.25, 0.25)
    assert [len(row) for row in scope.bins] == [live_grade.BINS] * 4


def test_picture_and_histogram_in_motion_share_one_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    colors = 0.4 + 0.2 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(1))
    grader = FormGrader()
    grader.sample = sample_of(colors)
    grader.rows = grader.sample.rows
    drawn = LiveColors()
    counts = []
    plain = live_grade._at_strength

    def count(colors: torch.Tensor, live: LiveGrade, *detail: torch.Tensor | None) -> torch.Tensor:
        counts.append(len(colors))
        return plain(colors, live, *detail)

    def frame(look: str) -> torch.Tensor:
        live = grader.live(with_look(FORM, look))
        assert live is not None
        grader.scope(live, is_moving=True)
        return drawn.recolor(live, colors, None)

    monkeypatch.setattr(live_grade, "_at_strength", count)
    frame("grade:exposure=0.3")
    counts.clear()
    graded = frame("grade:exposure=0.4")
    assert len(counts) == 1
    exact = grade_fully(colors, parse_grade("exposure=0.4"))
    assert (graded - exact).abs().mean() < 0.002


def test_histogram_at_rest_is_exact_and_close_to_that_in_motion() -> None:
    colors = torch.rand(2000, 3, generator=torch.Generator().manual_seed(1))
    grader = FormGrader()
    grader.sample = sample_of(colors)
    grader.rows = grader.sample.rows
    live = grader.live(with_look(FORM, "grade:exposure=0.4"))
    assert live is not None
    rest = grader.scope(live)
    values = grade_fully(colors, live.grade)
    assert rest.white == pytest.approx(float((values.amax(dim=1) > 1.0 - 0.5 / 255).float().mean()))
    moving = grader.scope(live, is_moving=True)
    assert np.abs(np.subtract(moving.bins, rest.bins)).mean() < 0.03


def test_form_is_graded_before_its_sample_has_arrived() -> None:
    grader = FormGrader()
    form = replace(FORM, grade=(1.0, *FORM.grade[1:]))
    assert grader.live(form) is None
    grader.rows = np.arange(10)
    assert grader.live(FORM) is None, "a neutral grade costs nothing"
    live = grader.live(form)
    assert live is not None
    assert grader.live(form) == live
    assert grader.live(replace(form, strength=0.0)) is None
    assert grader.live(replace(FORM, clipping=True)) is not None
    hovered = grader.live(replace(FORM, hovered_look="grade:saturation=-1.00"))
    assert hovered is not None
    assert hovered.grade.values["saturation"] == -1.0


@pytest.mark.parametrize("name", BUILT_IN)
def test_looks_are_grades_that_keep_the_palette(name: str) -> None:
    form = with_look(
        replace(FORM, palette=(("#7eae44", "#4474ae"),), region="selection"), f"grade:{BUILT_IN[name]}"
    )
    assert parse_grade(form.spec.partition(":")[2]).values == parse_grade(BUILT_IN[name]).values
    assert form.palette == (("#7eae44", "#7eae44"),)
    assert form.region == "selection"


def test_look_files_keep_their_settings(tmp_path: Path) -> None:
    table = grade_fully(lattice_colors(CUBE_SIDE).float(), GRADE)
    write_cube(tmp_path / "a.cube", table, "a", "exposure=0.40")
    assert read_settings(tmp_path / "a.cube") == "exposure=0.40"
    assert torch.allclose(read_cube(tmp_path / "a.cube"), table, atol=1e-5)


def test_tables_of_other_programs_are_looks_and_keep_half_the_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(user_files, "looks_folder", lambda: tmp_path)
    table = grade_fully(lattice_colors(CUBE_SIDE).float(), GRADE)
    write_cube(tmp_path / "film.cube", table, "film")
    write_cube(tmp_path / "own.cube", table, "own", "exposure=0.40")
    (tmp_path / "broken.cube").write_text("LUT_1D_SIZE 2")
    looks = dict(user_files.read_looks())
    assert looks["own"] == "grade:exposure=0.40"
    assert with_look(FORM, looks["film"]) == FORM, "the form has no settings for it"
    grader = FormGrader()
    colors = torch.rand(40, 3, generator=torch.Generator().manual_seed(1))
    grader.sample = sample_of(colors)
    grader.rows = np.arange(len(colors))
    live = grader.live(replace(FORM, hovered_look=looks["film"]))
    assert live is not None
    graded = ColorTable(colors).apply(live)
    assert torch.allclose(graded, grade_fully(colors, GRADE), atol=0.01), "as of its lattice"
    half = ColorTable(colors).apply(replace(live, strength=0.5))
    assert torch.allclose(half, grade_course(colors, GRADE)(0.5), atol=0.02)
    shown = grader.thumbnail(looks["film"])
    assert shown is not None
    assert np.abs(shown.reshape(-1, 3) / 255.0 - graded[:12].numpy()).max() < 0.01
    assert grader.thumbnail(looks["broken"]) is not None, "an unreadable table shows the view unchanged"
