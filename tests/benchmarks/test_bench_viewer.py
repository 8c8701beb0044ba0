"""Tests of the viewer benchmarks on small scenes: they run and measure the documented quantity."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import __main__ as front
from benchmarks.colors import grading
from benchmarks.table import Table
from benchmarks.viewer import frames as bench_frames
from benchmarks.viewer import moving, painting, popping, pull_response, subject
from benchmarks.viewer import slider as bench
from benchmarks.viewer import window as bench_window
from benchmarks.viewer.display import missing_tools
from benchmarks.viewer.mouse import Mouse
from benchmarks.viewer.scenes import copies, edit_for, scenes_of
from benchmarks.viewer.slider import SliderCase
from benchmarks.viewer.training import begin_training
from benchmarks.viewer.window import Dragging, Idle
from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.rasterize.screen import fill_screen
from tests.helpers.demo_scenes import bear
from tests.helpers.small_benchmarks import SMALL_TRAINING
from viewer.camera.view_camera import bounds_of, first_camera
from viewer.render import dynamic_resolution, engine
from viewer.render.cpu_renderer import CpuRenderer
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state.view_state import LayerState, ViewState

SIZE = (460, 400)


@pytest.mark.gl
def test_slider_table_has_a_row_with_error_for_each_renderer() -> None:
    ctx = headless_context()
    results = bench.rows(ctx, bear(600).gaussians, SliderCase(100, True), steps=2, size=SIZE)
    ctx.release()
    assert [result.way for result in results] == list(bench.RENDERERS)
    for result in results:
        assert len(result.events_ms) == len(result.parts) == 2
        assert min(result.processor_ms) > 0.0
        assert all(part.changed == 100 for part in result.parts)
        assert all(ms > part.total_ms for ms, part in zip(result.events_ms, result.parts, strict=True))
        assert result.psnr_db >= 65.0, "the early stop at 1e-4, in a picture of few pixels"
    table = bench.table(results, "a renderer")
    assert isinstance(table, Table)
    assert all(len(row) == len(table.columns) for row in table.rows)
    assert table.note.startswith("OpenGL by a renderer.")


@pytest.mark.gl
def test_turning_benchmark_draws_a_new_correct_frame_per_step(tmp_path: Path) -> None:
    path = tmp_path / "bear.ply"
    save_ply(path, bear(600).gaussians)
    ctx = headless_context()
    turnings = bench_frames.measure_turning(ctx, path, steps=2, size=SIZE)
    ctx.release()
    assert [turning.way for turning in turnings] == list(bench_frames.RENDERERS)
    for turning in turnings:
        assert len(turning.frames_ms) == len(turning.draws_ms) == len(turning.coarse_ms) == 2
        assert min(turning.draws_ms) > 0.0, "every frame is a new picture"
        assert turning.processor_ms > 0.0
        assert turning.coarse_processor_ms > 0.0
        assert (turning.count, turning.wrong) == (600, 0)
        assert turning.checked >= 2
        assert 10.0 < turning.coarse_db < 60.0
        assert turning.at_rest == 0
    starts = [bench_frames.Start(2.5, 0.8, 200.0), bench_frames.Start(1.5, 0.9, 300.0)]
    frames = bench_frames.frames_table(turnings, starts, "a renderer")
    coarse = bench_frames.coarse_table(turnings, "a renderer")
    assert [row[-2:] for row in frames.rows] == [("2.50 (0.80)", "200"), ("1.50 (0.90)", "300")]
    assert all(len(row) == len(table.columns) for table in (frames, coarse) for row in table.rows)


@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no process is halted there")
def test_moving_scene_is_timed_with_its_error_beside_a_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(moving, "_SETTLE_S", 0.05)
    ctx = headless_context()
    with begin_training(bear(600).gaussians, *SMALL_TRAINING) as training:
        result = moving.measure(ctx, bear(2000).gaussians, training, steps=2, size=(240, 200))
    ctx.release()
    assert len(result.turning) == len(result.beside) == 2
    assert 20.0 < result.db < 60.0
    assert abs(result.luminance) < 0.02
    assert result.processor > 0.0
    assert 0.0 < result.build < 1.0
    assert 0.1 < result.memory < 0.5, "a node for about four Gaussians"
    assert moving.table([result]).rows[0][0] == "2 000"


@pytest.mark.gl
def test_idle_picture_is_checked_only_once_it_is_sharp(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Simulate a large scene, whose sharp picture is made in the background and arrives some frames later."""
    path = tmp_path / "bear.ply"
    requests = list[int]()
    save_ply(path, bear(600).gaussians)
    prepare = CpuRenderer.prepare

    def slow(renderer: CpuRenderer, *picture: Any) -> bool:
        requests.append(1)
        return prepare(renderer, *picture) and len(requests) % 5 == 0

    monkeypatch.setattr(CpuRenderer, "prepare", slow)
    monkeypatch.setattr(dynamic_resolution, "SLOW_MS", -1.0)
    ctx = headless_context()
    turnings = bench_frames.measure_turning(ctx, path, steps=2, size=SIZE)
    ctx.release()
    assert len(requests) >= 5
    assert [turning.at_rest for turning in turnings] == [0, 0]


def test_popping_film_measures_only_changing_pixels() -> None:
    scene = bear(1500).gaussians
    views = [replace(first_camera(scene), azimuth=turn) for turn in (0.0, 1.0, 2.0)]
    turned, still = (popping.film("a path", scene, path, (240, 200)) for path in (views, views[:1] * 2))
    assert popping.table([turned]).rows[0][:2] == ("a path", "1 500")
    assert turned.sharp > 0.1
    assert 0.0 < turned.apart < turned.moving + turned.sharp
    assert still.sharp == still.moving == still.apart == still.blocks == 0.0
    assert turned.db > 25.0


@pytest.mark.gl
def test_moving_picture_is_compared_as_stretched_to_the_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    size = (43, 30)
    drawn = np.random.default_rng(0).random((15, 22, 3), np.float32)
    screen = np.zeros((size[1], size[0], 4), np.uint8)
    fill_screen(drawn, screen)
    full = screen[::-1, :, :3].astype(np.float32) / 255
    pixels = SimpleNamespace(pixels=lambda: drawn)
    work = SimpleNamespace(view=None)
    mouse = SimpleNamespace(
        size=size, engine=SimpleNamespace(renderer=pixels), main_view=SimpleNamespace(work=work)
    )
    monkeypatch.setattr(moving, "ViewEngine", lambda *_: SimpleNamespace(image=lambda *_: full))
    error, apart = moving._compare(mouse, None)  # type: ignore[arg-type]
    assert error > 20.0 * np.log10(255) + 10.0, "rounding to bytes alone"
    assert abs(apart) < 1e-3


def test_number_of_steps_is_limited_by_the_time_per_frame() -> None:
    assert bench_frames.affordable_steps(20, 0.05) == 20
    assert bench_frames.affordable_steps(20, bench_frames.TURN_S / 7.5) == 7
    assert bench_frames.affordable_steps(20, 1e4) == bench_frames.MIN_STEPS
    assert bench_frames.affordable_steps(2, 1e4) == 2


@pytest.mark.gl
def test_slow_turns_end_early_but_keep_their_pictures(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "bear.ply"
    save_ply(path, bear(600).gaussians)
    monkeypatch.setattr(bench_frames, "TURN_S", 0.0)
    ctx = headless_context()
    turnings = bench_frames.measure_turning(ctx, path, steps=20, size=SIZE)
    ctx.release()
    for turning in turnings:
        assert len(turning.frames_ms) == len(turning.coarse_ms) == bench_frames.MIN_STEPS
        assert turning.checked >= 1


@pytest.mark.gl
def test_frame_in_the_previous_sort_order_is_detected(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "bear.ply"
    save_ply(path, bear(600).gaussians)
    sort, last = engine.back_to_front, dict[int, Any]()

    def stale(means: Any, camera: Camera) -> Any:
        """Return the order of the engine's previous picture."""
        order = sort(means, camera)
        before = last.setdefault(means.ctypes.data, order)
        last[means.ctypes.data] = order
        return before if len(before) == len(order) else order

    monkeypatch.setattr(engine, "back_to_front", stale)
    ctx = headless_context()
    turnings = bench_frames.measure_turning(ctx, path, steps=2, size=SIZE)
    ctx.release()
    assert {turning.way: turning.wrong > 0 for turning in turnings} == {"gl": True, "cpu": False}


@pytest.mark.gl
def test_mouse_finds_the_slider_handle_and_the_picture() -> None:
    scene = bear(600).gaussians
    gdf = edit_for(scene, 50, moves=False)
    ctx = headless_context()
    drawn_by = ViewEngine(ctx, scene, [gdf], "cpu")
    view = ViewState(first_camera(scene), (LayerState(0, "edit", 0.3),), dynamic_resolution="off")
    with Mouse(ctx, drawn_by, scene, [gdf], view, SIZE) as mouse:
        mouse.grip_slider()
        assert mouse.main_view.work.view.layers[0].strength == pytest.approx(0.3)
        mouse.turn(24.2)
        mouse.release()
        assert mouse.main_view.work.view.layers[0].strength == pytest.approx(0.4, abs=0.01)
        assert mouse.main_view.work.view.camera == view.camera
        mouse.grip_picture()
        mouse.turn(10.0)
        mouse.release()
        assert mouse.main_view.work.view.camera.azimuth == pytest.approx(view.camera.azimuth - 3.0)
        assert mouse.picture().shape == (*SIZE[::-1], 3)
    drawn_by.release()
    ctx.release()


def test_generated_scenes_and_edits_are_reproducible_and_sized(tmp_path: Path) -> None:
    scene = bear(600).gaussians
    many = copies(scene, 3)
    radius = bounds_of(scene).radius
    assert len(many) == 1800
    assert torch.equal(many.means[:600], scene.means)
    off = (many.means[600:1200] - scene.means).std() / radius
    assert float(off) == pytest.approx(0.002, rel=0.1)
    assert torch.equal(many.means, copies(scene, 3).means)
    first = edit_for(scene, 70, moves=True)
    again = edit_for(scene, 70, moves=True)
    assert len(first.region) == 70
    assert torch.equal(first.field.attributes["means"].end_offset, again.field.attributes["means"].end_offset)
    assert set(edit_for(scene, 70, moves=False).field.attributes) == {"sh0"}
    for name, size in (("b.ply", 300), ("a.ply", 200)):
        save_ply(tmp_path / name, scene[:size])
    assert [len(s) for s in scenes_of([tmp_path / "b.ply", tmp_path / "a.ply"])] == [200, 300]


def test_memory_slope_ignores_an_outlier_and_finds_a_steady_rise() -> None:
    times = tuple(float(i) for i in range(60))
    flat = [500.0] * 60
    flat[50] = 480.0
    assert Dragging(times, tuple(flat), 1, ()).slope == 0.0
    rising = tuple(500.0 + 0.1 * t for t in times)
    assert Dragging(times, rising, 1, ()).slope == pytest.approx(6.0)
    table = bench_window.table([Idle("at rest", 0.05, 10.0)], Dragging(times, rising, 7, (3.0, 4.0)), 600)
    assert table.rows[0][1] == "0.5 % of one core"
    assert table.rows[1][2:] == ("500 → 506", "+6.00")
    assert all(len(row) == len(table.columns) for row in table.rows)


@pytest.mark.window
@pytest.mark.gl
@pytest.mark.slow
def test_real_window_is_measured_idle_and_during_a_slider_drag(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if missing := missing_tools():
        pytest.skip(f"{missing} is not installed")
    monkeypatch.setattr(bench_window, "SETTLED_S", 0.2)
    scene = bear(600).gaussians
    resting = bench_window.idle(scene, wall_s=0.2)
    assert len(resting) == 2
    assert all(one.wall_s >= 0.2 for one in resting)
    dragging = bench_window.dragged(scene, seconds=0.1)
    assert dragging.pictures >= len(dragging.slider_ms) >= 1, "a slow machine draws few pictures of a sweep"
    assert len(dragging.seconds) == len(dragging.memory_mb) >= 2
    assert min(dragging.memory_mb) > 50.0


@pytest.mark.window
@pytest.mark.gl
@pytest.mark.slow
def test_first_frame_of_progdf_view_is_timed_from_process_start(tmp_path: Path) -> None:
    if missing := missing_tools():
        pytest.skip(f"{missing} is not installed")
    save_ply(tmp_path / "bear.ply", bear(600).gaussians)
    start = bench_frames.measure_starts(tmp_path / "bear.ply", "gl", times=1, size=SIZE)
    assert 0.0 < start.imports_s < start.first_s
    assert start.memory_mb > 50.0


def test_options_of_another_benchmark_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="use python -m benchmarks viewer"):
        front.main(["rasterize", "--scenes", str(tmp_path / "a.ply")])
    with pytest.raises(ProgdfError, match="use python -m benchmarks window"):
        front.main(["frames", "--seconds", "3"])


def test_unmeasurable_benchmarks_are_skipped_unless_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(**_: object) -> list[Table]:
        raise ProgdfError("nothing here; something there")

    monkeypatch.setattr(front, "BENCHES", {"window": front.BENCHES["window"]})
    monkeypatch.setattr(bench_window, "tables", refuse)
    assert front.main([]) == 0
    assert "window is not measured: nothing here" in capsys.readouterr().err
    with pytest.raises(ProgdfError, match="nothing here"):
        front.main(["window"])


@pytest.mark.gl
def test_painting_benchmark_measures_a_stroke(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(painting, "DABS", 3)
    monkeypatch.setattr(painting, "TURNS", 2)
    monkeypatch.setattr(painting, "_REST_S", 0.2)
    ctx = headless_context()
    times = painting.measure(ctx, bear(600).gaussians, 12.0, SIZE)
    ctx.release()
    assert (len(times.dabs), len(times.turning)) == (3, 2)
    assert min(*times.dabs, *times.turning, times.press, times.release) > 0.0


@pytest.mark.gl
def test_grading_benchmark_drags_the_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grading, "WARM_UP", 2)
    ctx = headless_context()
    times = grading.measure(ctx, bear(600).gaussians, "all sections", steps=4, size=grading.SIZE)
    ctx.release()
    assert len(times.frames) == len(times.parts) == 4
    assert len(set(times.parts)) == 4, "every frame is a new picture"
    assert times.rest_db > 50.0
    assert grading.table([times]).rows[0][:2] == ("600", "all sections")


@pytest.mark.gl
def test_dragging_benchmark_measures_a_pull(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pull_response, "EVENTS", 3)
    monkeypatch.setattr(pull_response, "WARM_UP", 1)
    ctx = headless_context()
    times = pull_response.measure(ctx, bear(600).gaussians, 300, SIZE)
    ctx.release()
    assert 0 < times.members <= 300
    assert (len(times.events), len(times.steps), len(times.draw)) == (3, 3, 3)
    assert min(*times.events, *times.steps, *times.draw, times.preparation) > 0.0


def test_subject_table_has_an_overlap_per_view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subject, "bear", lambda: bear(6000))
    monkeypatch.setattr(subject, "SIZE", (160, 100))
    (table,) = subject.tables(plot=tmp_path / "subject.png")
    assert len(table.rows) == 1
    assert all(float(cell) > 0.9 for cell in table.rows[0][2 : 2 + len(subject.VIEWS)])
    assert (tmp_path / "subject.png").is_file()
    with pytest.raises(ProgdfError, match="labels"):
        subject.tables([tmp_path / "scene.ply"])
