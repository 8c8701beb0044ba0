"""Tests of pulls by their properties: rigid motions, fixed and separate parts, covariances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array
from torch import Tensor

from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians, concatenate, pack
from progdf.pull.course import Handle, PullCourse, path, pull
from progdf.pull.follow import bind, follow, rest_frames, widen
from progdf.pull.follow_kernel import MAX_STRETCH
from progdf.pull.graph import Floats, NodeGraph, build_graph
from progdf.pull.solve import Pose, Solver, nearest_rotations
from progdf.quaternions import rotation_matrices, turn_quats
from progdf.region import Region, from_mask, inside_box, whole_scene
from progdf.tidy import Step, bake, tidy

Point = tuple[float, float, float]
SPACING = 0.1


def bar(length: int = 24, width: int = 4, shift: Point = (0.0, 0.0, 0.0), degree: int = 1) -> Gaussians:
    """Return a solid bar of overlapping Gaussians along x, from 0 to length / 10."""
    generator = torch.Generator().manual_seed(length + width)
    sides = [torch.arange(count) * SPACING for count in (length, width, width)]
    grid = torch.stack(torch.meshgrid(*sides, indexing="ij"), dim=-1).reshape(-1, 3)
    count = len(grid)
    jitter = 0.2 * SPACING * (torch.rand(count, 3, generator=generator) - 0.5)
    scales = SPACING * (0.3 + 0.4 * torch.rand(count, 3, generator=generator))
    return Gaussians(
        grid + jitter + torch.tensor(shift),
        torch.randn(count, 4, generator=generator),
        scales.log(),
        torch.full((count,), 2.0),
        torch.full((count, 3), 0.5),
        0.1 * torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=generator),
    )


def at(scene: Gaussians, course: PullCourse, strength: float) -> Gaussians:
    """Return the scene at a strength of a pull, without the storage of an edit."""
    rows = pack(scene[course.region.members], with_shN=scene.sh_degree > 0)
    return scene.replace_rows(course.region.members, rows + course.offsets_at(strength))


def covariances(scene: Gaussians) -> Tensor:
    half = rotation_matrices(scene.unit_quats.double()) * scene.scales.double()[:, None, :]
    return half @ half.transpose(1, 2)


def grip(scene: Gaussians, point: Point, shift: Point, falloff: float | None = None) -> Handle:
    """Return a handle at the Gaussian nearest to a point."""
    nearest = (scene.means - torch.tensor(point)).norm(dim=1).argmin()
    x, y, z = scene.means[nearest].tolist()
    return Handle(whole_scene(scene), (x, y, z), shift, falloff)


def rigid_handles(scene: Gaussians, turn: Tensor, shift: Tensor) -> list[Handle]:
    """Return handles at far corners that move by one rigid motion."""
    center = scene.means.double().mean(dim=0)
    rotation = rotation_matrices(turn_quats(turn[None]))[0]
    handles = []
    for point in ((0, 0, 0), (0, 0.3, 0.3), (1.2, 0.3, 0), (2.3, 0, 0), (2.3, 0.3, 0), (2.3, 0, 0.3)):
        handle = grip(scene, point, (0.0, 0.0, 0.0))
        arm = torch.tensor(handle.point, dtype=torch.float64) - center
        x, y, z = (rotation @ arm + shift - arm).tolist()
        handles.append(Handle(handle.region, handle.point, (x, y, z)))
    return handles


def test_rigid_motion_of_all_handles_moves_everything_rigidly() -> None:
    scene = bar()
    turn = torch.tensor([0.2, 0.9, 0.4], dtype=torch.float64)
    shift = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    course = pull(scene, rigid_handles(scene, turn, shift))
    rotation = rotation_matrices(turn_quats(turn[None]))[0]
    center = scene.means.double().mean(dim=0)
    expected = (scene.means.double() - center) @ rotation.T + center + shift
    end = at(scene, course, 1.0)
    assert float((end.means - expected).norm(dim=1).max()) < 0.02 * SPACING
    turned = rotation @ covariances(scene) @ rotation.T
    assert float((covariances(end) - turned).abs().max()) < 0.02 * float(turned.abs().max())


def test_rigid_motion_keeps_lengths_at_every_strength() -> None:
    scene = bar()
    turn = torch.tensor([0.0, 1.6, 0.0], dtype=torch.float64)
    course = pull(scene, rigid_handles(scene, turn, torch.zeros(3, dtype=torch.float64)))
    before = torch.pdist(scene.means[::7])
    end = at(scene, course, 1.0).means
    for strength in (0.25, 0.5, 0.75, 1.0):
        now = torch.pdist(at(scene, course, strength).means[::7])
        assert float((now / before - 1.0).abs().max()) < 0.02
    blend = torch.pdist(torch.lerp(scene.means, end, 0.5)[::7])
    assert float((blend / before).min()) < 0.8


def test_pull_without_hold_translates_what_is_connected() -> None:
    scene = bar()
    course = pull(scene, [grip(scene, (2.3, 0.3, 0.3), (0.4, -0.2, 0.3))])
    moved = at(scene, course, 1.0).means - scene.means
    assert torch.allclose(moved, torch.tensor([0.4, -0.2, 0.3]).expand_as(moved), atol=1e-3)


def test_handle_reaches_its_target_and_the_held_end_keeps_its_bits() -> None:
    scene = bar()
    held = inside_box("held", scene, torch.tensor([-1.0, -1, -1]), torch.tensor([0.35, 1, 1]))
    handle = grip(scene, (2.3, 0.1, 0.1), (-0.5, 1.2, 0.0))
    course = pull(scene, [handle], held)
    row = int((scene.means - torch.tensor(handle.point)).norm(dim=1).argmin())
    end = at(scene, course, 1.0)
    assert torch.allclose(
        end.means[row], torch.tensor(handle.point) + torch.tensor(handle.pull), atol=0.05 * SPACING
    )
    for strength in (0.3, 1.0):
        now = at(scene, course, strength)
        for name in ATTRIBUTES:
            assert torch.equal(getattr(now, name)[held.members], getattr(scene, name)[held.members])


def test_edit_is_the_scene_at_zero_and_the_baked_pull_at_one() -> None:
    scene = bar(12)
    held = inside_box("held", scene, torch.tensor([-1.0, -1, -1]), torch.tensor([0.25, 1, 1]))
    course = pull(scene, [grip(scene, (1.1, 0.1, 0.1), (-0.2, 0.6, 0.0))], held)
    step = Step("pull", course.region, course=course)
    gdf = tidy(scene, [step], "pull")
    start = compose_layers(scene, [Layer(gdf, 0.0)])
    for name in ATTRIBUTES:
        assert torch.equal(getattr(start, name), getattr(scene, name))
    baked = bake(scene, [step])
    end = compose_layers(scene, [Layer(gdf, 1.0)])
    assert torch.allclose(pack(end, True), pack(baked, True), atol=1e-3)
    half = compose_layers(scene, [Layer(gdf, 0.5)])
    assert torch.allclose(half.means, at(scene, course, 0.5).means, atol=0.05 * SPACING)


def test_turned_handle_turns_the_surface_around_it() -> None:
    scene = bar()
    held = inside_box("held", scene, torch.tensor([-1.0, -1, -1]), torch.tensor([0.35, 1, 1]))
    handle = replace(grip(scene, (2.2, 0.1, 0.1), (0.0, 0.0, 0.0)), turn=(1.2, 0.0, 0.0))
    course = pull(scene, [handle], held)
    rotation = rotation_matrices(turn_quats(torch.tensor([[1.2, 0.0, 0.0]], dtype=torch.float64)))[0]
    center = torch.tensor(handle.point, dtype=torch.float64)
    near = (scene.means - center).norm(dim=1) < 2.0 * SPACING
    for strength, share in ((1.0, 1.0), (0.5, 0.5)):
        turn = torch.tensor([[share * 1.2, 0.0, 0.0]], dtype=torch.float64)
        rotation = rotation_matrices(turn_quats(turn))[0]
        expected = (scene.means.double() - center) @ rotation.T + center
        error = (at(scene, course, strength).means - expected).norm(dim=1)
        assert float(error[near].max()) < 0.4 * SPACING
    middle = (scene.means[:, 0] - 1.2).abs() < 0.1
    assert float((at(scene, course, 1.0).means - scene.means)[middle].norm(dim=1).max()) > 0.3 * SPACING


def test_scaled_handle_scales_the_surface_around_it() -> None:
    scene = bar()
    held = inside_box("held", scene, torch.tensor([-1.0, -1, -1]), torch.tensor([0.35, 1, 1]))
    handle = replace(grip(scene, (2.2, 0.1, 0.1), (0.0, 0.0, 0.0)), scale=1.5)
    end = at(scene, pull(scene, [handle], held), 1.0)
    near = (scene.means - torch.tensor(handle.point)).norm(dim=1) < 1.5 * SPACING
    ratio = torch.pdist(end.means[near]) / torch.pdist(scene.means[near])
    assert float(ratio.median()) == pytest.approx(1.5, abs=0.15)
    growth = (end.log_scales - scene.log_scales)[near].mean()
    assert float(growth) == pytest.approx(math.log(1.5), abs=0.15)


def test_pinned_point_stays_and_the_rest_turns_around_it() -> None:
    scene = bar()
    pin = tuple(scene.means[(scene.means - torch.tensor([0.0, 0.1, 0.1])).norm(dim=1).argmin()].tolist())
    course = pull(scene, [grip(scene, (2.3, 0.1, 0.1), (-0.6, 1.2, 0.0))], pins=[pin])
    end = at(scene, course, 1.0)
    row = int((scene.means - torch.tensor(pin)).norm(dim=1).argmin())
    assert float((end.means[row] - scene.means[row]).norm()) < 0.1 * SPACING
    middle = (scene.means - torch.tensor([1.2, 0.1, 0.1])).norm(dim=1).argmin()
    assert float((end.means[middle] - scene.means[middle]).norm()) > 3.0 * SPACING


@pytest.mark.parametrize(
    ("turn", "scale", "message"),
    [((0.0, math.nan, 0.0), 1.0, "finite"), ((0.0, 7.0, 0.0), 1.0, "360"), (None, 0.0, "scales by")],
)
def test_invalid_frame_of_a_handle_is_refused(turn: Point | None, scale: float, message: str) -> None:
    scene = bar()
    handle = replace(grip(scene, (2.3, 0.1, 0.1), (0.1, 0.0, 0.0)), turn=turn, scale=scale)
    with pytest.raises(ProgdfError, match=message):
        pull(scene, [handle])


def test_turn_of_a_single_gaussian_is_refused() -> None:
    scene = bar()[:1]
    handle = replace(grip(scene, (0.0, 0.0, 0.0), (0.1, 0.0, 0.0)), turn=(0.0, 1.0, 0.0))
    with pytest.raises(ProgdfError, match="too few Gaussians"):
        pull(scene, [handle])


def test_mirrored_pulls_of_a_symmetric_graph_mirror_the_result() -> None:
    positions = np.array([[x, y, 0.0] for x in (-2.0, -1.0, 1.0, 2.0) for y in (0.0, 1.0)])
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    starts, ends = np.nonzero((distance > 0) & (distance < 2.1))
    nodes = np.arange(8)
    graph = NodeGraph(positions, nodes, starts, ends, np.zeros(8, np.int64), 1.0)
    mirror = np.array([-1.0, 1.0, 1.0])
    poses = []
    for node, side in ((6, 1.0), (0, -1.0)):
        blends = csr_array(([1.0], ([0], [node])), shape=(1, 8))
        held = nodes == (0 if side > 0 else 6)
        solver = Solver(graph, blends, positions[[node]], held, np.zeros(8))
        poses.append(solver.solve(positions[[node]] + np.array([[side * 0.3, 0.5, 0.4]]), solver.rest()))
    order = [6, 7, 4, 5, 2, 3, 0, 1]
    assert np.allclose(poses[1].positions[order] * mirror, poses[0].positions, atol=1e-3)


def test_solver_at_rest_changes_nothing() -> None:
    scene = bar(12)
    graph = build_graph(scene)
    blends = bind(graph, graph.positions[:2], np.arange(2))
    points = np.asarray(blends @ graph.positions)
    solver = Solver(graph, blends, points, np.zeros(len(graph), bool), np.zeros(len(graph)))
    pose = solver.solve(points, solver.rest())
    assert np.allclose(pose.positions, graph.positions, atol=1e-9)
    assert np.allclose(pose.rotations, np.eye(3), atol=1e-9)


def test_far_cluster_and_rows_beyond_the_falloff_stay() -> None:
    scene = concatenate([bar(), bar(6, shift=(0.0, 2.0, 0.0))])
    count = len(bar())
    course = pull(scene, [grip(scene, (2.3, 0.1, 0.1), (0.0, 0.4, 0.0))])
    assert torch.equal(at(scene, course, 1.0).means[count:], scene.means[count:])
    near = pull(scene, [grip(scene, (2.3, 0.1, 0.1), (0.0, 0.4, 0.0), 0.8)])
    beyond = (scene.means - torch.tensor([2.3, 0.1, 0.1])).norm(dim=1) > 0.85
    assert torch.equal(at(scene, near, 1.0).means[beyond], scene.means[beyond])


def test_parts_of_other_color_and_normal_are_not_connected() -> None:
    scene = concatenate([bar(width=2, degree=0), bar(width=2, shift=(0.0, 0.3, 0.0), degree=0)])
    half = len(scene) // 2
    sh0 = scene.sh0.clone()
    sh0[half:] = -0.5
    flat = scene.log_scales.clone()
    flat[:half, 0] -= 3.0
    flat[half:, 1] -= 3.0
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(scene), 4)
    scene = Gaussians(scene.means, quats, flat, scene.logit_opacities, sh0, scene.shN)
    graph = build_graph(scene)
    assert not set(graph.part[graph.node_of[:half]]) & set(graph.part[graph.node_of[half:]])


@pytest.mark.parametrize("falloff", [None, 0.5])
def test_single_gaussian_is_moved(falloff: float | None) -> None:
    scene = bar()[:1]
    course = pull(scene, [grip(scene, (0.0, 0.0, 0.0), (0.1, 0.2, -0.3), falloff)])
    end = at(scene, course, 1.0)
    assert torch.allclose(end.means - scene.means, torch.tensor([[0.1, 0.2, -0.3]]), atol=1e-4)
    assert torch.allclose(covariances(end), covariances(scene), rtol=1e-4)


def test_pull_through_itself_stays_finite_and_bounded() -> None:
    scene = bar(16)
    held = inside_box("held", scene, torch.tensor([-1.0, -1, -1]), torch.tensor([0.35, 1, 1]))
    course = pull(scene, [grip(scene, (1.5, 0.1, 0.1), (-3.0, 0.02, 0.0))], held)
    assert bool(torch.isfinite(course.offsets).all())
    largest = math.log(MAX_STRETCH) + 1e-3
    growth = course.offsets[:, :, 3:6].amax(dim=2)
    spread = scene.log_scales[course.region.members]
    assert float((growth - (spread.amax(dim=1) - spread.amin(dim=1))).max()) < largest


@pytest.mark.parametrize(
    ("point", "shift", "falloff", "message"),
    [
        ((9.0, 0.0, 0.0), (0.1, 0.0, 0.0), None, "from its region"),
        ((0.0, 0.0, 0.0), (1e6, 0.0, 0.0), None, "diagonal"),
        ((0.0, 0.0, 0.0), (math.nan, 0.0, 0.0), None, "finite"),
        ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), 1e-9, "from its region"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), None, "0"),
        ((2.3, 0.1, 0.1), (0.1, 0.0, 0.0), None, "held"),
    ],
)
def test_invalid_pull_is_refused(point: Point, shift: Point, falloff: float | None, message: str) -> None:
    scene = bar()
    held = inside_box("held", scene, torch.tensor([1.8, -1, -1]), torch.tensor([9.0, 1, 1]))
    with pytest.raises(ProgdfError, match=message):
        pull(scene, [Handle(whole_scene(scene), point, shift, falloff)], held)


def test_empty_region_is_refused() -> None:
    scene = bar()
    nothing = from_mask("nothing", torch.zeros(len(scene), dtype=torch.bool))
    with pytest.raises(ProgdfError, match="no Gaussian"):
        pull(scene, [Handle(nothing, (0.0, 0.0, 0.0), (0.1, 0.0, 0.0))])


def test_opposite_pulls_of_one_point_are_refused() -> None:
    scene = bar()
    handles = [grip(scene, (2.3, 0.15, 0.15), (shift, 0.0, 0.0)) for shift in (0.4, -0.4)]
    with pytest.raises(ProgdfError, match="no Gaussian follows"):
        pull(scene, handles)


def test_covariances_take_the_affine_gradient() -> None:
    scene = bar(12)
    graph = build_graph(scene)
    points = scene.means.double().numpy()
    gradient = np.array([[1.8, 0.3, 0.0], [0.0, 0.8, 0.1], [0.0, 0.0, 1.1]])
    gradients: Floats = np.broadcast_to(gradient, (len(graph), 3, 3)).copy()
    pose = Pose(graph.positions @ gradient.T, nearest_rotations(gradients, np.eye(3)[None]))
    rows = pack(scene, with_shN=True).double()
    binding = widen(graph, bind(graph, points, graph.node_of), rows, graph.node_of)
    packed, _ = follow(rows, binding, graph, pose, gradients, rest_frames(rows))
    stretched = scene.replace_rows(torch.arange(len(scene)), packed).to(dtype=torch.float64)
    matrix = torch.from_numpy(gradient)
    expected = matrix @ covariances(scene) @ matrix.T
    assert torch.allclose(stretched.means, scene.means.double() @ matrix.T, atol=1e-5)
    assert float((covariances(stretched) - expected).abs().max()) < 1e-4 * float(expected.abs().max())


def test_rotations_are_the_polar_factors() -> None:
    generator = np.random.default_rng(3)
    turns = torch.from_numpy(generator.normal(size=(40, 3)))
    rotations = rotation_matrices(turn_quats(turns)).numpy()
    stretch = np.eye(3) + 0.2 * generator.normal(size=(40, 3, 3))
    stretch = stretch @ np.swapaxes(stretch, 1, 2)
    identity = np.broadcast_to(np.eye(3), rotations.shape)
    found = nearest_rotations(rotations @ stretch, identity)
    assert np.allclose(found, rotations, atol=1e-6)


def test_path_of_a_turning_handle_is_an_arc() -> None:
    turn = np.array([[0.0, 0.0, math.pi / 2]])
    half = path(np.array([[-1.0, 1.0, 0.0]]), turn, 0.5)[0] + np.array([1.0, 0.0, 0.0])
    assert np.allclose(half, [math.sqrt(0.5), math.sqrt(0.5), 0.0], atol=1e-6)
    straight = path(np.array([[0.4, 0.2, 0.0]]), np.zeros((1, 3)), 0.5)
    assert np.allclose(straight, [[0.2, 0.1, 0.0]], atol=1e-9)


def test_neighboring_region_is_not_pulled() -> None:
    scene = bar()
    region: Region = inside_box("end", scene, torch.tensor([1.2, -1, -1]), torch.tensor([9.0, 1, 1]))
    handle = grip(scene, (2.3, 0.1, 0.1), (0.2, 0.0, 0.0))
    course = pull(scene, [Handle(region, handle.point, handle.pull)])
    assert bool(torch.isin(course.region.members, region.members).all())
