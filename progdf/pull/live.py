"""Live pull: the same problem as the course, solved a few rounds at a time while handles are dragged.

The graph and the factorization are computed once for a set of handles. Each step starts from the last pose,
so it is fast for small movements. Its result is the end of an edit in progress, whose offsets are replaced in
place.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from progdf.compose.composer import Composer
from progdf.compose.layers import DEFAULT_BLEND, Layer
from progdf.field.baked import AttributeBases, BakedField
from progdf.gaussians import BASE_CHANNELS, Gaussians, attribute_slices, pack
from progdf.gdf.file import Gdf, fingerprint
from progdf.gdf.motions import linear_map
from progdf.quaternions import multiply_quats
from progdf.rasterize.cpu.compilation import compile_elsewhere, is_compiled, mark_compiled
from progdf.region import Region, from_mask, whole_scene
from progdf.similarity import AffineMotion, transform_rows
from progdf.system.equality import equal_fields

from .course import Handle, make_problem
from .cuts import NO_CUTS, Cuts
from .follow import bind, follow_in_place, rest_frames, widen
from .graph import MAX_NODES, Floats, Rows

_SETTLED_SHARE = 1e-3
"""Movement of a node in a step below which the pose counts as settled, in node spacings."""
_CHANGED = ("means", "log_scales", "quats", "shN")  # attributes that a pull changes


@dataclass(frozen=True, eq=False)
class HandlePose:
    """Displacements, rotations and scales of H handles."""

    pulls: Floats  # displacements, finite, world units. [H,3]
    turns: Floats  # rotation vectors, radians; without effect on a handle that turns freely. [H,3]
    scales: Floats  # factors, above 0; without effect on such a handle. [H]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, HandlePose):
            return NotImplemented
        pairs = ((self.pulls, other.pulls), (self.turns, other.turns), (self.scales, other.scales))
        return all(np.array_equal(a, b) for a, b in pairs)

    @classmethod
    def of_shifts(cls, pulls: Floats) -> HandlePose:
        """Return the pose of handles that are only displaced. pulls: [H,3]"""
        return cls(pulls, np.zeros_like(pulls), np.ones(len(pulls)))


@dataclass(frozen=True)
class LiveStep:
    """Result of one step."""

    __eq__ = equal_fields

    pose: HandlePose  # of the handles
    # packed offsets of the members from the scene, overwritten by the step after the next. [M,C] float32
    offsets: Tensor
    is_settled: bool  # further steps with the same displacements change nothing visible
    milliseconds: float  # time that the step took


class LivePull:
    """Pull of some handles that is solved step by step.

    The constructor takes up to seconds for large regions. Use one object in one thread at a time.

    Args:
        scene: the scene as it is without the pull
        handles: at least one; their displacements and scales are ignored, their turns if there are any
        hold: Gaussians that stay as they are
        max_nodes: target number of nodes of the graph
        cuts: cuts between the Gaussians of the scene

    Raises:
        ProgdfError: see `progdf.pull.course.pull`.
    """

    def __init__(
        self,
        scene: Gaussians,
        handles: Sequence[Handle],
        hold: Region | None = None,
        max_nodes: int = MAX_NODES,
        cuts: Cuts = NO_CUTS,
    ) -> None:
        self._problem = make_problem(scene, handles, hold, max_nodes, cuts=cuts)
        graph = self._problem.graph
        rows = self._problem.members
        moves = np.ones(len(rows), bool)
        if hold is not None:
            moves = ~hold.mask.numpy()[rows]
        points = scene.means.detach().double().numpy()[rows]
        binding = bind(graph, points, graph.node_of)
        moves &= binding @ (~self._problem.held).astype(float) > 0.0
        self.members: Rows = rows[moves]
        """Gaussians that can move, ascending. [M]"""
        if not moves.all():
            binding = csr_array(binding[np.flatnonzero(moves)])
        self.influence: Floats = binding @ self._problem.influence
        """Share of the handles' motion that each of them may follow, 0 to 1. [M]"""
        rows_of_members = pack(scene[torch.from_numpy(self.members)], with_shN=scene.sh_degree > 0)
        self._rows = rows_of_members.detach().float().contiguous()
        self._binding = widen(graph, binding, self._rows, graph.node_of[moves])
        self._frames = rest_frames(self._rows)
        self._offsets = (torch.empty_like(self._rows), torch.empty_like(self._rows))
        self._pose = self._problem.solver.rest()

    @property
    def channels(self) -> int:
        """Width of a packed row, C."""
        return self._rows.shape[1]

    @property
    def node_count(self) -> int:
        """Number of nodes of the graph."""
        return len(self._problem.graph)

    @property
    def cut_count(self) -> int:
        """Number of links between Gaussians that the cuts removed."""
        return self._problem.graph.cut_count

    def step(self, handles: HandlePose, rounds: int) -> LiveStep:
        """Solve some rounds for a pose of the handles.

        Args:
            handles: displacements, rotations and scales
            rounds: number of rounds, at least 1
        """
        began = time.perf_counter()
        problem = self._problem
        targets = problem.targets(handles.pulls, handles.turns, handles.scales)
        pose = problem.solver.solve(targets, self._pose, rounds)
        moved = float(np.abs(pose.positions - self._pose.positions).max(initial=0.0))
        self._pose = pose
        gradients = problem.solver.gradients(pose)
        offsets = self._offsets[0]
        self._offsets = self._offsets[::-1]
        follow_in_place(self._rows, self._binding, problem.graph, pose, gradients, self._frames, offsets)
        return LiveStep(
            handles,
            offsets,
            moved <= _SETTLED_SHARE * problem.graph.spacing,
            1e3 * (time.perf_counter() - began),
        )


def edit_in_progress(scene: Gaussians, members: Rows, channels: int, name: str) -> Gdf:
    """Return an edit of some Gaussians without offsets yet, see `write_offsets`.

    Args:
        scene: the scene with the rows that other edits add
        members: rows of the scene, ascending. [M]
        channels: width of a packed row
        name: name of the layer
    """
    slices = attribute_slices(channels)
    bases = {}
    for attribute in _CHANGED:
        if attribute in slices:
            width = slices[attribute].stop - slices[attribute].start
            bases[attribute] = AttributeBases(
                torch.zeros(len(members), width),
                torch.zeros(0, len(members), width),
                torch.ones(1, width),
                torch.tensor([[0.0], [1.0]]),
            )
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[torch.from_numpy(members)] = True
    field = BakedField("keyframes", torch.tensor([0.0, 1.0]), bases, channels)
    return Gdf(name, from_mask(name, mask), field, fingerprint(scene), adds=True)


def _in_bytes(field: BakedField) -> BakedField:
    """Return a field whose residual bases are of the type of a saved edit."""
    attributes = {
        name: replace(bases, residual_basis=bases.residual_basis.to(torch.int8))
        for name, bases in field.attributes.items()
    }
    return replace(field, attributes=attributes)


def write_offsets(edit: Gdf, offsets: Tensor) -> None:
    """Replace the offsets of an edit in progress in place. [M,C]"""
    slices = attribute_slices(edit.field.channels)
    for attribute, bases in edit.field.attributes.items():
        bases.end_offset.copy_(offsets[:, slices[attribute]])


def write_move(edit: Gdf, rows: Tensor, motion: AffineMotion) -> None:
    """Write the offsets of a move into an edit in progress, in place.

    A similarity maps all rows by the same matrices, which takes a tenth of the time of `transform_rows`.

    Args:
        edit: see `edit_in_progress`
        rows: raw rows of its members before the move, packed. [M,C] float32
        motion: with its pivot
    """
    slices = attribute_slices(edit.field.channels)
    bands = edit.field.channels - BASE_CHANNELS
    moved = linear_map([motion], 1.0, bands // 3)
    if motion.mirror is not None or motion.pivot is None or not moved.is_similar:
        exact = rows.double()
        write_offsets(edit, transform_rows(exact, motion) - exact)
        return
    offsets = {name: bases.end_offset for name, bases in edit.field.attributes.items()}
    arms = rows[:, slices["means"]].double() - motion.pivot
    offsets["means"].copy_(arms @ (moved.matrix - torch.eye(3, dtype=torch.float64)).T + motion.shift)
    offsets["log_scales"].fill_(moved.log_scale)
    if not motion.turns_colors:
        for name in ("quats", "shN"):
            if name in offsets:
                offsets[name].zero_()
        return
    axes = torch.eye(4, dtype=torch.float64)
    change = multiply_quats(moved.turn.expand(4, 4), axes) - axes
    offsets["quats"].copy_(rows[:, slices["quats"]] @ change.float())
    if "shN" in offsets:
        by_band = torch.kron(moved.bands - torch.eye(bands // 3, dtype=torch.float64), torch.eye(3)).float()
        shN = rows[:, slices["shN"]]
        for degree in range(1, math.isqrt(bands // 3 + 1)):  # bands do not mix
            band = slice(3 * (degree**2 - 1), 3 * ((degree + 1) ** 2 - 1))
            offsets["shN"][:, band] = shN[:, band] @ by_band[band, band].T


def has_kernels() -> bool:
    """Return True if the kernels of a live pull have been compiled on this machine."""
    return is_compiled(__name__)


def compile_kernels(stop: threading.Event) -> None:
    """Compile the kernels of a live pull in another process, so that this one goes on meanwhile.

    If that fails, the first pull compiles them.

    Args:
        stop: ends the work once it is set
    """
    compile_elsewhere(__name__, stop)


def warm_up() -> None:
    """Load the kernels of a live pull, or compile them the first time on a machine."""
    corners = torch.cartesian_prod(*[torch.linspace(-1.0, 1.0, 4)] * 3)
    count = len(corners)
    quats = torch.eye(4)[:1].repeat(count, 1)
    scene = Gaussians(
        means=corners,
        quats=quats,
        log_scales=corners - 2.0,
        logit_opacities=corners[:, 0].clone(),
        sh0=corners,
        shN=torch.zeros(count, 3, 3),
    )
    x, y, z = corners[0].tolist()
    handle = Handle(whole_scene(scene), (x, y, z), (0.0, 0.0, 0.0))
    live = LivePull(scene, [handle])
    step = live.step(HandlePose.of_shifts(np.array([[0.1, 0.0, 0.0]])), 1)
    edit = edit_in_progress(scene, live.members, live.channels, "pulled")
    write_offsets(edit, step.offsets)
    saved = replace(edit, field=_in_bytes(edit.field))
    composer = Composer(scene, (edit, saved))
    for layers in ([Layer(edit)], [Layer(saved)], []):
        composer.update(layers, DEFAULT_BLEND)
    mark_compiled(__name__)
