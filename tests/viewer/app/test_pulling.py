"""The Pull tool: press and drag, layers by Enter, undo, pins and limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from imgui_bundle import imgui
from imgui_bundle.imguizmo import im_guizmo

from progdf.gdf.file import save_gdf
from progdf.pull.live import LiveStep
from progdf.region import whole_scene
from progdf.tidy import Step, similarity, tidy
from tests.helpers.edits import bits
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.app.app import App
from viewer.app.parts import pulling
from viewer.app.pull.transform import gizmo_of, with_matrix
from viewer.camera.decal_warp import project, vec3
from viewer.camera.view_camera import to_camera
from viewer.state import selection
from viewer.state.transient import Pull, PullHandle
from viewer.state.workspace import with_transient
from viewer.ui.glfw_library import glfw

pytestmark = pytest.mark.gl


@pytest.fixture
def app(folder: Path) -> Iterator[App]:
    with null_app(opened_document(folder), first_view(bear()), folder) as app:
        yield app


def pull_of(app: App) -> Pull:
    pull = app.main_view.work.transient.gizmo
    assert isinstance(pull, Pull)
    return pull


def place_of(app: App, row: int) -> tuple[float, float]:
    """Return the window position of a Gaussian."""
    camera = to_camera(app.main_view.work.view.camera, *app.main_view.picture_size)
    means = app.engine.gaussians(app.main_view.work.view).means[row].double().numpy()
    x, y = project(means, camera)[0].tolist()
    density = imgui.get_io().display_framebuffer_scale
    return x / density.x, y / density.y


def on_scarf(app: App) -> tuple[float, float]:
    """Return the middle of the scarf, which no part of the interface covers."""
    rows = bear().demo.members("scarf")
    x, y = np.mean([place_of(app, int(row)) for row in rows], axis=0).tolist()
    return round(x), round(y)


def frame(app: App) -> None:
    app.main_view.wake()
    app.draw()
    app.parts.pulling.settle()
    app.draw()


def move(app: App, x: float, y: float) -> None:
    glfw.set_cursor_pos(app.window.handle, x, y)
    frame(app)


def button(app: App, down: bool) -> None:
    imgui.get_io().add_mouse_button_event(0, down)
    frame(app)


def drag(app: App, start: tuple[float, float], by: tuple[float, float]) -> None:
    move(app, *start)
    button(app, True)
    for share in (0.5, 1.0):
        move(app, start[0] + share * by[0], start[1] + share * by[1])
    button(app, False)


def means(app: App) -> torch.Tensor:
    return app.engine.gaussians(app.main_view._displayed_view()).means[: len(bear().scene)].clone()


def test_surface_follows_the_pointer_and_enter_makes_a_layer(app: App) -> None:
    original = bits(bear().scene)
    before = means(app)
    press(app, "Shift+P")
    drag(app, on_scarf(app), (30.0, -20.0))
    (handle,) = pull_of(app).pose.handles
    assert np.linalg.norm(handle.pull) > 0.0
    assert [layer.name for layer in app.main_view.work.transient.live] == ["pulled"]
    moved = means(app) - before
    nearest = int((before - torch.tensor(handle.point)).norm(dim=1).argmin())
    torch.testing.assert_close(moved[nearest], torch.tensor(handle.pull), atol=0.05, rtol=0.2)
    far = (before - torch.tensor(handle.point)).norm(dim=1) > pull_of(app).radius
    assert not moved[far].any()
    live = means(app)
    press(app, "Enter")
    app.parts.pulling.settle()
    app.draw()
    layer = app.main_view.work.view.layers[-1]
    assert (layer.name, layer.strength) == ("pulled", 1.0)
    assert app.main_view.work.transient.gizmo is None
    assert not app.main_view.work.transient.live
    size = float(np.linalg.norm(handle.pull))
    assert float((means(app) - live).norm(dim=1).max()) < 0.1 * size
    press(app, "Ctrl+Z")
    assert torch.equal(means(app), before)
    assert bits(app.documents.get().original) == original


def test_pull_on_a_turned_part_follows_the_turn(app: App) -> None:
    scene = bear().scene
    scarf = scene.means[bear().demo.members("scarf")].double().mean(dim=0)
    turn = replace(similarity(turn=(0.0, 0.0, 0.5 * math.pi)), pivot=scarf)
    gdf = tidy(scene, [Step("transform", whole_scene(scene), turn)], "turn")
    app.parts.maker.begin("turn", lambda _name, path, _progress: save_gdf(path, gdf), lambda _ready: None)
    app.parts.maker.wait()
    app.draw()
    press(app, "Shift+P")
    before = means(app)
    drag(app, on_scarf(app), (30.0, -20.0))
    (handle,) = pull_of(app).pose.handles
    moved = means(app) - before
    nearest = int((before - torch.tensor(handle.point)).norm(dim=1).argmin())
    torch.testing.assert_close(moved[nearest], torch.tensor(handle.pull), atol=0.05, rtol=0.2)
    press(app, "Enter")
    app.parts.pulling.settle()
    app.draw()
    torch.testing.assert_close(means(app)[nearest] - before[nearest], moved[nearest], atol=0.02, rtol=0.1)
    gdf = app.documents.get().gdfs[-1]
    at = int((gdf.region.members == nearest).nonzero())
    x, y, z = gdf.field.attribute_offsets("means", 1.0)[at].tolist()
    torch.testing.assert_close(torch.tensor([-y, x, z]), moved[nearest], atol=0.02, rtol=0.1)


def test_held_drag_is_solved_on_until_it_settles(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pulling, "_ROUNDS", 1)
    monkeypatch.setattr(pulling, "_FIRST_ROUNDS", 1)
    press(app, "Shift+P")
    start = on_scarf(app)
    move(app, *start)
    button(app, True)
    glfw.set_cursor_pos(app.window.handle, start[0] + 60.0, start[1] - 40.0)
    app.main_view.wake()
    app.draw()
    steps = list[LiveStep]()
    for _ in range(3000):  # frames and looks without input, as the window's loop makes them
        waits = [wait for wait in app._wait_times() if wait is not None]
        app.window.wait(min(waits, default=0.02))
        if app.main_view.is_due():
            app.draw()
        step = app.parts.pulling.last_step
        if step is not None and (not steps or step is not steps[-1]):
            steps.append(step)
            if step.is_settled:
                break
    assert steps[-1].is_settled
    assert len(steps) > 1, "the first round does not settle"
    assert pull_of(app).drag is not None, "the button is still down"
    last = means(app)
    frame(app)
    handle = pull_of(app).pose.handles[0]
    assert float((means(app) - last).norm(dim=1).max()) < 0.02 * float(np.linalg.norm(handle.pull))
    button(app, False)


def test_escape_ends_the_drag_and_then_the_tool(app: App) -> None:
    before = means(app)
    press(app, "Shift+P")
    start = on_scarf(app)
    move(app, *start)
    button(app, True)
    move(app, start[0] + 30.0, start[1])
    assert not torch.equal(means(app), before)
    press(app, "Escape")
    frame(app)
    assert not pull_of(app).pose.handles
    assert torch.equal(means(app), before)
    button(app, False)
    drag(app, start, (0.0, -25.0))
    press(app, "Escape")
    frame(app)
    assert app.main_view.work.transient.gizmo is None
    assert torch.equal(means(app), before)
    assert not app.main_view.work.view.layers


def test_drags_are_undone_and_redone_one_by_one(app: App) -> None:
    press(app, "Shift+P")
    start = on_scarf(app)
    drag(app, start, (20.0, 0.0))
    first = pull_of(app).pose
    drag(app, (start[0] + 20.0, start[1]), (0.0, -15.0))
    (handle,) = pull_of(app).pose.handles
    assert handle.point == first.handles[0].point
    assert handle.pull != first.handles[0].pull
    press(app, "Ctrl+Z")
    assert pull_of(app).pose == first
    press(app, "Ctrl+Z")
    assert not pull_of(app).pose.handles
    press(app, "Ctrl+Shift+Z", "Ctrl+Y")
    assert pull_of(app).pose.handles == (handle,)


def test_axis_keys_and_alt_restrict_the_drag(app: App) -> None:
    press(app, "Shift+P")
    start = on_scarf(app)
    move(app, *start)
    button(app, True)
    press(app, "X")
    move(app, start[0] + 30.0, start[1] - 30.0)
    pull = np.array(pull_of(app).pose.handles[0].pull)
    assert pull[0] != 0.0
    assert np.allclose(pull[1:], 0.0, atol=1e-9)
    press(app, "X")
    imgui.get_io().add_key_event(imgui.Key.mod_alt, True)
    frame(app)
    drag_state = pull_of(app).drag
    assert drag_state is not None
    pull = np.array(pull_of(app).pose.handles[0].pull)
    imgui.get_io().add_key_event(imgui.Key.mod_alt, False)
    button(app, False)
    assert np.linalg.norm(np.cross(pull, drag_state.normal)) < 1e-6 * max(np.linalg.norm(pull), 1e-9)


def test_wheel_changes_the_radius_over_the_surface_and_zooms_beside_it(app: App) -> None:
    press(app, "Shift+P")
    radius = pull_of(app).radius
    camera = app.main_view.work.view.camera
    move(app, *on_scarf(app))
    imgui.get_io().add_mouse_wheel_event(0.0, 2.0)
    frame(app)
    assert pull_of(app).radius == pytest.approx(1.21 * radius)
    assert app.main_view.work.view.camera == camera
    move(app, 80.0, 150.0)
    imgui.get_io().add_mouse_wheel_event(0.0, 1.0)
    frame(app)
    assert app.main_view.work.view.camera != camera


def test_click_pins_and_shift_click_frees(app: App) -> None:
    press(app, "Shift+P")
    start = on_scarf(app)
    move(app, *start)
    button(app, True)
    button(app, False)
    assert len(pull_of(app).pose.pins) == 1
    assert not pull_of(app).pose.handles
    imgui.get_io().add_key_event(imgui.Key.mod_shift, True)
    frame(app)
    button(app, True)
    button(app, False)
    imgui.get_io().add_key_event(imgui.Key.mod_shift, False)
    assert not pull_of(app).pose.pins
    frame(app)


def test_selection_limits_or_holds(app: App) -> None:
    mask = np.zeros(app.main_view.facts.count, bool)
    mask[bear().demo.members("scarf")] = True
    view = app.main_view.work.view
    app.main_view.store.change(replace(view, selection=selection.select(view.selection, mask)))
    before = means(app)
    press(app, "Shift+P")
    app.main_view.store.replace(with_transient(app.main_view.work, gizmo=replace(pull_of(app), whole=True)))
    drag(app, on_scarf(app), (25.0, 0.0))
    moved = (means(app) != before).any(dim=1)
    assert moved.any()
    assert not moved[~torch.from_numpy(mask[: len(moved)])].any()


def test_layer_of_a_pull_is_in_the_session(app: App, folder: Path) -> None:
    press(app, "Shift+P")
    drag(app, on_scarf(app), (25.0, 0.0))
    press(app, "Enter")
    app.parts.pulling.settle()
    (path,) = [path for path in app.documents.get().gdf_paths if path.stem == "pulled"]
    assert path.is_file()
    assert app.documents.get().gdfs[app.main_view.work.view.layers[-1].gdf].instruction == "pull"


def pulled(app: App) -> tuple[float, float]:
    """Pull the scarf; return the window position of its handle, which is picked."""
    press(app, "Shift+P")
    start = on_scarf(app)
    drag(app, start, (20.0, 0.0))
    assert pull_of(app).picked == 0
    return start[0] + 20.0, start[1]


def test_typed_turn_and_scale_of_a_handle_make_a_layer(app: App) -> None:
    before = means(app)
    pulled(app)
    first = pull_of(app).pose
    press(app, "R", "Z", *"200", "Enter")
    frame(app)
    press(app, "S", *"1.5", "Enter")
    frame(app)
    (handle,) = pull_of(app).pose.handles
    assert handle.turn == pytest.approx((0.0, 0.0, np.radians(200.0)))
    assert handle.scale == pytest.approx(1.5)
    assert handle.pull == first.handles[0].pull
    assert pull_of(app).past[-1].handles[0].scale == 1.0
    live = means(app)
    assert not torch.equal(live, before)
    press(app, "Ctrl+Z", "Ctrl+Z")
    frame(app)
    assert pull_of(app).pose == first
    press(app, "Ctrl+Y", "Ctrl+Y")
    frame(app)
    assert pull_of(app).pose.handles == (handle,)
    press(app, "Enter")
    app.parts.pulling.settle()
    app.draw()
    assert app.main_view.work.transient.gizmo is None
    far = (means(app) - live).norm(dim=1)
    assert float(far.max()) < 0.1 * float((live - before).norm(dim=1).max())
    press(app, "Ctrl+Z")
    assert torch.equal(means(app), before)


def test_escape_ends_a_typed_turn_before_the_tool(app: App) -> None:
    pulled(app)
    pose = pull_of(app).pose
    press(app, "R", "X", *"45")
    frame(app)
    assert pull_of(app).pose != pose
    press(app, "Escape")
    frame(app)
    assert pull_of(app).pose == pose
    assert pull_of(app).transform is None
    press(app, "G", "Y", *"0.1", "Enter")
    frame(app)
    moved = np.subtract(pull_of(app).pose.handles[0].pull, pose.handles[0].pull)
    assert moved == pytest.approx([0.0, 0.1, 0.0])


def test_ring_of_the_gizmo_turns_the_handle(app: App) -> None:
    x, y = pulled(app)
    at = project(
        np.array(pull_of(app).pose.handles[0].target),
        to_camera(app.main_view.work.view.camera, *app.main_view.picture_size),
    )[0]
    density = imgui.get_io().display_framebuffer_scale
    x, y = float(at[0]) / density.x, float(at[1]) / density.y
    operation = im_guizmo.OPERATION
    # to a ring on the left, far from the circles that scale
    for away, angle in product(range(40, 120, 3), np.radians(range(120, 260, 30))):
        across, down = away * np.cos(angle), away * np.sin(angle)
        move(app, x + across, y + down)
        if im_guizmo.is_over(operation.rotate) and not im_guizmo.is_over(operation.translate):
            break
    else:
        pytest.fail("there is no ring")
    pose = pull_of(app).pose
    before = pose.handles[0]
    button(app, True)
    for step in range(1, 6):
        move(app, x + across - 0.1 * step * down, y + down + 0.1 * step * across)
    assert pull_of(app).transform is not None
    button(app, False)
    frame(app)
    assert pull_of(app).transform is None
    (handle,) = pull_of(app).pose.handles
    assert handle.turn is not None
    assert np.linalg.norm(handle.turn) > 0.05
    assert (handle.scale, handle.pull) == (1.0, before.pull)
    assert pull_of(app).past[-1] == pose
    press(app, "Ctrl+Z")
    assert pull_of(app).pose == pose


def test_matrix_of_a_handle_goes_both_ways() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        axis = random.normal(size=3)
        turn = vec3(axis / np.linalg.norm(axis) * random.uniform(0.0, 6.2))
        scale = float(random.uniform(0.1, 9.0))
        handle = PullHandle((0.1, 0.2, 0.3), vec3(random.normal(size=3)), turn, scale)
        matrix = gizmo_of(handle).matrix
        assert with_matrix(replace(handle, pull=(0.0, 0.0, 0.0)), matrix, "move") == handle
        assert with_matrix(replace(handle, scale=1.0), matrix, "scale").scale == pytest.approx(scale)
        near = replace(handle, turn=vec3(0.99 * np.array(turn)))
        turned = with_matrix(near, matrix, "rotate")
        assert turned.turn == pytest.approx(turn)
        assert (turned.scale, turned.pull) == (scale, handle.pull)
        matrix[:3, :3] = matrix[:3, :3] @ np.diag([1.0, 2.0, 1.0])
        stretched = with_matrix(handle, matrix, "scale")
        assert stretched.scale == pytest.approx(2.0 * scale)
        assert stretched.turn == turn
