"""Typed transforms of a selection: keys give exactly the transform, and undo gives back the bits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import opened_document
from tests.helpers.ui_rig import bear, first_view, rig
from viewer.app import typed
from viewer.app.app import App
from viewer.state import selection
from viewer.state.transient import Gizmo, Pivot, PlacedPart
from viewer.ui.keys import Keys, Press

pytestmark = pytest.mark.gl


@pytest.fixture
def app(folder: Path) -> Iterator[App]:
    with null_app(opened_document(folder), first_view(bear()), folder) as app:
        mask = np.zeros(app.main_view.facts.count, bool)
        mask[bear().demo.members("scarf")] = True
        view = app.main_view.work.view
        app.main_view.store.change(replace(view, selection=selection.select(view.selection, mask)))
        yield app


def gizmo_of(app: App) -> Gizmo:
    gizmo = app.main_view.work.transient.gizmo
    assert isinstance(gizmo, Gizmo)
    return gizmo


def strike(app: App, text: str) -> None:
    """Press keys one after the other: single characters, or names separated by spaces."""
    press(app, *text.split())


def means(app: App) -> torch.Tensor:
    """Return the centers of the scarf as the window shows them."""
    view = app.main_view._displayed_view()
    members = bear().demo.members("scarf")
    return app.engine.gaussians(view).means[members].clone()


def turned(axis: int, degrees: float) -> NDArray[np.float64]:
    angle = np.radians(degrees)
    first, second = ((1, 2), (2, 0), (0, 1))[axis]
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[first, second] = -np.sin(angle)
    matrix[second, first] = np.sin(angle)
    return matrix


CASES: dict[str, tuple[NDArray[np.float64], tuple[float, float, float]]] = {
    "G X 1 . 5": (np.eye(3), (1.5, 0, 0)),
    "G Z - 0 . 2 5": (np.eye(3), (0, 0, -0.25)),
    "G 1 Tab 2 Tab - 3": (np.eye(3), (1, 2, -3)),
    "G Shift+Z . 5 Tab 1": (np.eye(3), (0.5, 1, 0)),
    "G Y 1 2 Backspace": (np.eye(3), (0, 1, 0)),
    "G X Y Num3 Num. Num5": (np.eye(3), (0, 3.5, 0)),
    "G X 2 - -": (np.eye(3), (2, 0, 0)),
    "R Z 4 5": (turned(2, 45), (0, 0, 0)),
    "R X - 3 0": (turned(0, -30), (0, 0, 0)),
    "R Shift+Y 9 0": (turned(1, 90), (0, 0, 0)),
    "S 2": (2 * np.eye(3), (0, 0, 0)),
    "S X . 5": (np.diag([0.5, 1, 1]), (0, 0, 0)),
    "S Shift+X 3": (np.diag([1, 3, 3]), (0, 0, 0)),
    "S Z -": (np.diag([1, 1, -1]), (0, 0, 0)),
    "G X 1 Enter R Z 9 0 Enter S 2": (2 * turned(2, 90), (1, 0, 0)),
    "G X 1 R Z 9 0": (turned(2, 90), (1, 0, 0)),
    "G X 1 Enter G Y 5 Escape": (np.eye(3), (1, 0, 0)),
}


@pytest.mark.parametrize("text", CASES)
def test_typed_keys_give_exactly_the_transform(app: App, text: str) -> None:
    linear, shift = CASES[text]
    before = means(app).double()
    strike(app, "Alt+M")
    strike(app, text)
    matrix = gizmo_of(app).matrix
    np.testing.assert_allclose(matrix[:3, :3], linear, atol=1e-15)
    np.testing.assert_allclose(matrix[:3, 3], shift, atol=1e-15)
    center = before.mean(dim=0)
    expected = center + torch.tensor(shift) + (before - center) @ torch.from_numpy(linear).double().T
    torch.testing.assert_close(means(app).double(), expected, atol=2e-5, rtol=0)
    if gizmo_of(app).typed is not None:
        strike(app, "Enter")
    strike(app, "Enter")
    assert app.main_view.work.transient.gizmo is None
    assert app.main_view.work.view.layers[-1].name == "moved"
    torch.testing.assert_close(means(app).double(), expected, atol=2e-4, rtol=0)


def test_escape_undoes_the_transform_and_then_the_handles(app: App) -> None:
    before = means(app)
    strike(app, "Alt+M G X 2 Escape")
    assert gizmo_of(app).typed is None
    assert torch.equal(means(app), before)
    strike(app, "R Y 5 0 Escape Escape")
    assert app.main_view.work.transient.gizmo is None
    assert not app.main_view.work.transient.live
    assert torch.equal(means(app), before)
    assert not app.main_view.work.view.layers


def test_mirroring_twice_keeps_no_layer(app: App) -> None:
    strike(app, "Alt+M S X - 1 Enter S X - 1 Enter")
    assert not gizmo_of(app).is_moved
    strike(app, "Enter")
    assert not app.main_view.work.view.layers


def test_undo_gives_back_the_bits(app: App) -> None:
    before = means(app)
    strike(app, "Alt+M R Z 3 0 Enter Enter")
    assert not torch.equal(means(app), before)
    strike(app, "Ctrl+Z")
    assert torch.equal(means(app), before)


def test_undo_and_redo_step_through_motions_of_the_handles(app: App) -> None:
    selected = app.main_view.work.view.selection.members
    before = means(app)
    strike(app, "Alt+M G X 2 Enter")
    moved = gizmo_of(app).matrix
    shown = means(app)
    strike(app, "R Y 5 0 Enter")
    turned_too = gizmo_of(app).matrix
    strike(app, "Ctrl+Z")
    assert np.array_equal(gizmo_of(app).matrix, moved)
    assert torch.equal(means(app), shown)
    strike(app, "Ctrl+Z")
    assert not gizmo_of(app).is_moved
    assert torch.equal(means(app), before)
    strike(app, "Ctrl+Y Ctrl+Shift+Z")
    assert np.array_equal(gizmo_of(app).matrix, turned_too)
    assert app.main_view.work.view.selection.members == selected


def test_keys_of_a_transform_do_nothing_else(app: App) -> None:
    work = app.main_view.work
    strike(app, "Alt+M G X 1 2 . - Backspace Y Tab S R")
    after = app.main_view.work
    assert after.view.select.tool == work.view.select.tool
    assert after.view.compare == work.view.compare
    assert after.view.camera == work.view.camera
    assert after.focus == work.focus
    assert after.keyboard == ""


def part_of(points: int = 400) -> PlacedPart:
    rng = np.random.default_rng(5)
    up = np.array([0.6, 0.0, 0.8])
    cloud = rng.normal(size=(points, 3)) * [1.0, 0.5, 2.0]
    x, y, z = up.tolist()
    return PlacedPart(cloud - cloud.mean(axis=0), (x, y, z), -0.7, bear().scene)


def handles_of(matrix: NDArray[np.float64]) -> Gizmo:
    return Gizmo("transform", (0.3, -0.2, 1.0), matrix, part=part_of())


def similar(seed: int) -> NDArray[np.float64]:
    """Return a matrix that stretches, rotates and moves."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    turn = Rotation.random(random_state=seed).as_matrix()
    matrix[:3, :3] = turn @ np.diag(rng.uniform(0.3, 2.0, 3))
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def base_height(gizmo: Gizmo) -> float:
    part = gizmo.part
    assert part is not None
    world = part.points @ gizmo.matrix[:3, :3].T + gizmo.matrix[:3, 3] + gizmo.center
    return float(np.quantile(world @ np.array(part.up), typed._BASE_SHARE))


@pytest.mark.parametrize("seed", range(4))
def test_snap_to_ground_puts_the_base_on_the_ground(seed: int) -> None:
    before = handles_of(similar(seed))
    after = typed.on_ground(before)
    assert base_height(after) == pytest.approx(-0.7)
    assert np.array_equal(after.matrix[:3, :3], before.matrix[:3, :3])
    moved = after.matrix[:3, 3] - before.matrix[:3, 3]
    np.testing.assert_allclose(np.cross(moved, [0.6, 0.0, 0.8]), 0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_snap_to_surface_aligns_the_up_axis_with_the_normal(seed: int) -> None:
    gizmo = handles_of(similar(seed))
    part = gizmo.part
    assert part is not None
    normal = Rotation.random(random_state=seed).as_matrix()[0]
    point = np.array([1.0, 2.0, 3.0])
    matrix = typed.on_surface(part, gizmo.center, gizmo.matrix, point, normal)
    world = part.points @ matrix[:3, :3].T + matrix[:3, 3] + gizmo.center
    assert np.quantile((world - point) @ normal, typed._BASE_SHARE) == pytest.approx(0.0, abs=1e-12)
    turn = matrix[:3, :3] @ np.linalg.inv(gizmo.matrix[:3, :3])
    np.testing.assert_allclose(turn @ np.array(part.up), normal, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_mirror_about_the_base_twice_is_the_identity(axis: int) -> None:
    gizmo = typed.with_pivot(handles_of(similar(axis)), "base")
    once = typed.mirror_part(gizmo, axis)
    assert np.linalg.det(once.matrix) < 0.0
    np.testing.assert_allclose(typed.pivot_of(once, once.matrix), typed.pivot_of(gizmo, gizmo.matrix))
    np.testing.assert_allclose(typed.mirror_part(once, axis).matrix, gizmo.matrix, atol=1e-12)


@pytest.mark.parametrize("text", ["R Z 9 0", "S 3", "S X -"])
def test_rotation_and_scale_keep_the_pivot(text: str) -> None:
    gizmo = typed.with_pivot(handles_of(similar(2)), "base")
    keys = Keys(tuple(Press(chord) for chord in text.split()))
    with rig(first_view(bear())) as hand:
        pointer = hand.main_view.pointer()
        moved, unused = typed.take_keys(gizmo, keys, pointer)
        assert not unused.pressed
        after = typed.follow(moved, pointer, hand.main_view.decal_surfaces)
    assert not np.allclose(after.matrix, gizmo.matrix)
    np.testing.assert_allclose(
        typed.pivot_of(after, after.matrix), typed.pivot_of(gizmo, gizmo.matrix), atol=1e-12
    )


@pytest.mark.parametrize("pivot", ["center", "base"])
def test_fields_set_position_rotation_and_scale(pivot: Pivot) -> None:
    gizmo = typed.with_pivot(handles_of(np.eye(4)), pivot)
    start = typed.fields_of(gizmo)
    np.testing.assert_allclose(start.angles, 0.0)
    np.testing.assert_allclose(start.scale, 1.0)
    wanted = typed.Fields(
        np.array([1.0, -2.0, 0.5]), np.array([20.0, 100.0, -30.0]), np.array([2.0, 0.5, -1.0])
    )
    for name in ("position", "angles", "scale"):
        before = typed.fields_of(gizmo)
        gizmo = typed.with_fields(gizmo, before, replace(before, **{name: getattr(wanted, name)}))
    after = typed.fields_of(gizmo)
    np.testing.assert_allclose(after.position, wanted.position, atol=1e-12)
    np.testing.assert_allclose(after.angles, wanted.angles, atol=1e-9)
    np.testing.assert_allclose(after.scale, wanted.scale, atol=1e-12)


def test_ctrl_steps_the_mouse_by_15_degrees_and_tenths() -> None:
    with rig(first_view(bear())) as hand:
        camera = hand.main_view.pointer().camera(hand.main_view.work.view.camera)
    gizmo = replace(handles_of(np.eye(4)), center=bear_center())
    for does, step in (("rotate", 15.0), ("scale", 0.1)):
        transform = typed.TypedTransform(does, np.eye(4))  # type: ignore[arg-type]
        sight = typed.Sight(camera, (300.0, 100.0), (411.0, 237.0), steps=True)
        (value,) = typed.value_of(gizmo, transform, sight)
        assert value / step == pytest.approx(round(value / step))
        (free,) = typed.value_of(gizmo, transform, replace(sight, steps=False))
        assert abs(free - value) <= 0.5 * step
        assert free != value


def bear_center() -> tuple[float, float, float]:
    x, y, z = bear().scene.means.double().mean(dim=0).tolist()
    return x, y, z


@pytest.mark.parametrize("axes", ["", "X", "Y", "YZ", "XZ"])
def test_mouse_moves_the_part_with_the_pointer_along_the_axes(axes: str) -> None:
    with rig(first_view(bear())) as hand:
        camera = hand.main_view.pointer().camera(hand.main_view.work.view.camera)
    gizmo = replace(handles_of(np.eye(4)), center=bear_center())
    start = typed._project(np.array(gizmo.center), camera)
    before = (float(start[0]), float(start[1]))
    sight = typed.Sight(camera, before, (before[0] + 40.0, before[1] - 25.0))
    offset = np.array(typed.value_of(gizmo, typed.TypedTransform("move", np.eye(4), axes), sight))
    for axis in range(3):
        if axes and "XYZ"[axis] not in axes:
            assert offset[axis] == 0.0
    end = typed._project(np.array(gizmo.center) + offset, camera)
    if len(axes) != 1:
        np.testing.assert_allclose(end, sight.now, atol=1e-6)
    else:
        moved = end - start
        assert float(moved @ np.array([40.0, -25.0])) > 0.0
