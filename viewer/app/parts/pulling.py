"""Pulls in the window: the scene follows the handles of the Pull tool, and Enter makes a layer with a slider.

Graphs are built, and steps solved, in other threads. The window shows the newest finished step.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.composer import Composer
from progdf.compose.layer_paint import layer_of
from progdf.compose.layers import Layer
from progdf.compose.parents.rest import RestFrame, rest_frame
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, save_gdf
from progdf.pull.course import Handle, pull
from progdf.pull.cuts import CutLine, Cuts
from progdf.pull.grips import connected_rows, with_grips
from progdf.pull.live import (
    HandlePose,
    LivePull,
    LiveStep,
    compile_kernels,
    edit_in_progress,
    has_kernels,
    warm_up,
    write_offsets,
)
from progdf.region import Region, from_mask
from progdf.scene.point_tree import PointTree
from progdf.system.equality import equal_fields
from progdf.threads import one_thread
from progdf.tidy import Step, tidy
from viewer.app.messages import Requests, error_line
from viewer.app.parts.making import LayerMaker, Progress
from viewer.camera.view_camera import Vec3
from viewer.files.document import DocumentStore
from viewer.render.engine import ViewEngine
from viewer.state import selection
from viewer.state.layers import visible_layers
from viewer.state.transient import Pull, PullCut, PullInfluence, PullPose
from viewer.state.view_state import LayerState
from viewer.state.workspace import Store, with_transient

_NAME = "pulled"
_PREPARING = "Preparing …"
_COMPILING = "Compiling this tool for your machine, once; this takes about 20 s …"
_FIRST_RADIUS = 0.15  # radius of the influence at first, in radii of what can be pulled
_ROUNDS = 24  # rounds of the solver per step while a handle is dragged
_FIRST_ROUNDS = 60  # rounds before the first step is shown
_PATIENCE_S = 0.012  # time that a frame waits for its step, so that fast steps show in the same frame
_REST_S = 0.05  # time without input until a pose that has not settled is solved further
_PIN_GAUSSIANS = 48  # Gaussians that a pin holds


@dataclass(frozen=True)
class _Problem:
    """Inputs of a live pull. Displacements are not part of it."""

    engine: ViewEngine
    gdfs: tuple[Gdf, ...] = field(compare=False)  # the engine's edits without the edit in progress
    layers: tuple[LayerState, ...]  # visible layers
    blend: str
    limit: bytes  # packed mask of the Gaussians that may move, `EMPTY_MASK` for all
    hidden: bytes  # packed mask of the hidden Gaussians
    held: bytes  # packed mask of the Gaussians that stay in place
    points: tuple[Vec3, ...]  # points of the handles, without the pull
    framed: tuple[bool, ...]  # True for handles that turn or scale the surface around them
    pins: tuple[Vec3, ...]
    cuts: tuple[PullCut, ...]
    radius: float | None  # radius of the influence; None: all that is connected


@dataclass(frozen=True)
class _Prepared:
    """Live pull with its edit in progress, and a composer that includes it."""

    __eq__ = equal_fields

    problem: _Problem
    owners: NDArray[np.int64]  # index of the tool's handle that each point of the pull moves with. [K]
    live: LivePull
    edit: Gdf
    composer: Composer
    is_cut: bool  # the cuts separate a Gaussian from the handles
    frame: RestFrame | None  # turns offsets back before the moves of the scene; None: there are none


class _Bases:
    """Scene under the layers below a pull, and its parts. The last ones are cached."""

    def __init__(self) -> None:
        self._key: object = None
        self._scene: Gaussians | None = None
        self._parts: dict[object, NDArray[np.int64]] = {}

    def scene(self, problem: _Problem, count: int) -> Gaussians:
        """Return the scene's own Gaussians under the visible layers. [N]"""
        key = (problem.engine, problem.layers, problem.blend)
        if self._scene is None or self._key != key:
            scene = compose_layers(problem.engine.scene, _stack(problem), problem.blend)
            self._scene = scene if len(scene) == count else scene[torch.arange(count)]
            self._key = key
            self._parts.clear()
        return self._scene

    def connected_part(
        self, scene: Gaussians, mask: NDArray[np.bool_], rows: NDArray[np.int64], cuts: tuple[PullCut, ...]
    ) -> Region:
        """Return the part of a mask that is connected with some rows."""
        key = (mask.tobytes(), rows.tobytes(), cuts)
        if key not in self._parts:
            allowed = np.flatnonzero(mask)
            start = np.searchsorted(allowed, rows).clip(max=len(allowed) - 1)
            found = connected_rows(scene[torch.from_numpy(allowed)], start, _lines(cuts))
            self._parts[key] = allowed[found]
        part = np.zeros(len(mask), bool)
        part[self._parts[key]] = True
        return from_mask(_NAME, torch.from_numpy(part))


class PullActions:
    """The Pull tool's effect on the scene.

    Args:
        store: state of the window
        documents: the open document
        maker: makes the layers
        engine: returns the engine that draws the window
        wake: ends the window's wait for events; callable from any thread
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        maker: LayerMaker,
        engine: Callable[[], ViewEngine],
        wake: Callable[[], None],
    ) -> None:
        self._store = store
        self._documents = documents
        self._maker = maker
        self._engine = engine
        self._wake = wake
        self._builder = ThreadPoolExecutor(1, thread_name_prefix="pull graph")
        self._stepper = ThreadPoolExecutor(1, thread_name_prefix="pull step")
        self._bases = _Bases()
        self._preparing: tuple[_Problem, Future[_Prepared]] | None = None
        self._refused: _Problem | None = None  # it cannot be solved
        self._prepared: _Prepared | None = None
        self._base: tuple[ViewEngine, Composer, tuple[Gdf, ...]] | None = None  # without the pull
        self._stepping: Future[LiveStep] | None = None
        self._solved: LiveStep | None = None
        self._solved_at = 0.0  # time of the last step, seconds
        self._compiling: Future[None] | None = None  # of the kernels, once on a machine
        self._stop_compiling = threading.Event()
        self._keeping = False  # the pull becomes a layer, and is drawn until then

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about pulls, by name."""
        return {
            "pull": lambda _: self._toggle(),
            "keep_pull": lambda _: self._keep(),
            "leave_pull": lambda _: self._leave(),
        }

    def leave_scene(self) -> None:
        """Drop the pull when another scene opens."""
        self._preparing = self._base = None
        self._keeping = False
        self._forget()
        self._set(None)

    def close(self) -> None:
        """Stop the threads."""
        self._stop_compiling.set()
        self._builder.shutdown(wait=False, cancel_futures=True)
        self._stepper.shutdown(wait=False, cancel_futures=True)

    def poll(self) -> float | None:
        """Start work for the current handles and show finished work."""
        pull = self._pull
        if pull is None:
            if not self._keeping and self._prepared is not None:
                self._clear()
            return None
        problem = self._problem(pull)
        if self._base is not None and self._base[0] is not self._engine():
            self._forget()  # another document is drawn, without the pull
        if self._compiling is not None and self._compiling.done():
            self._compiling = None
            self._report("" if self._preparing is None else _PREPARING)
        if problem is None:
            if self._prepared is not None:
                self._clear()
            self._report("" if self._compiling is None else _COMPILING)
            return None
        self._take_prepared(problem)
        self._prepare(problem, pull)
        return self._step(pull)

    def follow(self) -> None:
        """Start work for a handle that is being dragged, and wait shortly for its result, before drawing."""
        pull = self._pull
        if pull is not None and pull.is_held:
            self.poll()

    @property
    def last_step(self) -> LiveStep | None:
        """Step on screen, if there is one."""
        return self._solved

    @property
    def size(self) -> tuple[int, int]:
        """Number of Gaussians that the handles can move, and number of nodes; zeros without a graph."""
        prepared = self._prepared
        return (0, 0) if prepared is None else (len(prepared.live.members), prepared.live.node_count)

    def settle(self) -> None:
        """Wait until the window shows the pull of the current handles."""
        while True:
            self._solved_at = 0.0
            delay = self.poll()
            running = list[Future[Any]]()
            if self._preparing is not None:
                running.append(self._preparing[1])
            if self._stepping is not None:
                running.append(self._stepping)
            if self._keeping:
                self._maker.wait()
                continue
            if delay is None and not running:
                return
            wait(running)

    @property
    def _pull(self) -> Pull | None:
        gizmo = self._store.get().transient.gizmo
        return gizmo if isinstance(gizmo, Pull) else None

    def _set(self, pull: Pull | None) -> None:
        work = self._store.get()
        if pull is not None or isinstance(work.transient.gizmo, Pull):
            self._store.replace(with_transient(work, gizmo=pull))
            self._store.wake()

    def _report(self, status: str) -> None:
        pull = self._pull
        if pull is not None and pull.status != status:
            self._set(replace(pull, status=status))

    def _toggle(self) -> None:
        if self._pull is not None:
            self._leave()
            return
        if self._keeping:  # its handles are on screen until then
            self._maker.check_free()
        document = self._documents.get()
        if document.is_empty:
            raise ProgdfError("no scene is open; open one first")
        state = self._store.get().view.selection
        mask = selection.unpack(state.members, len(document.scene))[: len(document.original)]
        size = document.bounds.radius
        if mask.any():
            means = document.original.means[torch.from_numpy(mask.copy())].double()
            size = float((means - means.mean(dim=0)).norm(dim=1).quantile(0.9))
        self._set(Pull(max(_FIRST_RADIUS * size, 1e-9)))
        if not has_kernels() and self._compiling is None:
            self._compiling = self._builder.submit(compile_kernels, self._stop_compiling)
            self._compiling.add_done_callback(lambda _: self._wake())
            self._report(_COMPILING)
        self._builder.submit(warm_up)

    def _leave(self) -> None:
        self._set(None)
        if not self._keeping:
            self._clear()

    def _problem(self, pull: Pull) -> _Problem | None:
        """Return the inputs of the pull; None without handles."""
        if not pull.pose.handles:
            return None
        engine = self._engine()
        base = self._base
        gdfs = engine.gdfs if base is None or base[0] is not engine else base[2]
        view = self._store.get().view
        selected = view.selection.members if view.selection.count else selection.EMPTY_MASK
        holds = pull.holds_selection
        layers = tuple(
            LayerState(layer.gdf, "", layer.strength, gains=layer.gains, paint=layer.paint)
            for layer in visible_layers(view)
            if layer.strength
        )
        return _Problem(
            engine=engine,
            gdfs=gdfs,
            layers=layers,
            blend=view.blend,
            limit=selection.EMPTY_MASK if holds else selected,
            hidden=view.selection.hidden,
            held=selected if holds else selection.EMPTY_MASK,
            points=tuple(handle.point for handle in pull.pose.handles),
            framed=tuple(handle.turn is not None for handle in pull.pose.handles),
            pins=pull.pose.pins,
            cuts=pull.pose.cuts,
            radius=None if pull.whole else pull.radius,
        )

    def _prepare(self, problem: _Problem, pull: Pull) -> None:
        """Begin to build the graph of a problem unless it is known; a running build ends first."""
        known = self._prepared is not None and self._prepared.problem == problem
        if known or self._preparing is not None or problem == self._refused:
            return
        count = len(self._documents.get().original)
        future = self._builder.submit(_prepare, self._bases, problem, _pose(pull), count)
        future.add_done_callback(lambda _: self._wake())
        self._preparing = problem, future
        if self._prepared is None and self._compiling is None:
            self._report(_PREPARING)

    def _take_prepared(self, problem: _Problem) -> None:
        """Show a finished graph, also of an earlier radius, as long as its handles are the current ones."""
        if self._preparing is None or not self._preparing[1].done():
            return
        built, future = self._preparing
        self._preparing = None
        if built.engine is not problem.engine or built.points != problem.points:
            return
        try:
            prepared = future.result()
        except Exception as error:
            line = error_line(error)
            self._refused = built
            self._report(line)
            if not line:
                raise
            return
        if self._stepping is not None:
            wait([self._stepping])
            self._stepping = None
        engine = self._engine()
        if self._base is None:
            self._base = engine, engine.composer, engine.gdfs
        engine.adopt(prepared.composer, (*self._base[2], prepared.edit))
        self._prepared = prepared
        self._solved = None
        self._show_layer(len(self._base[2]))
        self._report("")
        pull = self._pull
        if pull is not None:
            influence = PullInfluence(prepared.live.members, prepared.live.influence, prepared.is_cut)
            self._set(replace(pull, edit=prepared.edit, influence=influence))

    def _show_layer(self, index: int) -> None:
        """Show the edit in progress above the other live edits."""
        work = self._store.get()
        others = tuple(layer for layer in work.transient.live if layer.gdf < index)
        live = (*others, LayerState(index, _NAME, 1.0))
        self._store.replace(with_transient(work, live=live))
        self._store.wake()

    def _step(self, pull: Pull) -> float | None:
        """Show a finished step and begin the next one.

        Returns:
            Seconds until the next look, None for never.
        """
        prepared = self._prepared
        if prepared is None:
            return None
        self._take_step(prepared)
        handles = pull.pose.handles
        if prepared.problem.points != tuple(handle.point for handle in handles):
            return None
        pose = _point_pose(_pose(pull), prepared.owners)
        solved = self._solved
        is_current = solved is not None and solved.pose == pose
        if self._stepping is not None or (is_current and solved is not None and solved.is_settled):
            return None
        rest = self._solved_at + _REST_S - time.perf_counter()
        if is_current and rest > 0.0:
            return rest  # the next movement need not wait for this step
        self._stepping = self._stepper.submit(_solve, prepared.live, pose)
        wait([self._stepping], _PATIENCE_S)
        if self._stepping.done():
            self._take_step(prepared)
            return _REST_S
        self._stepping.add_done_callback(lambda _: self._wake())
        return None

    def _take_step(self, prepared: _Prepared) -> None:
        if self._stepping is None or not self._stepping.done():
            return
        future = self._stepping
        self._stepping = None
        self._solved = future.result()
        self._solved_at = time.perf_counter()
        write_offsets(prepared.edit, _rest_offsets(prepared.frame, self._solved.offsets))
        self._engine().touch(prepared.edit)
        self._store.wake()

    def _clear(self) -> None:
        """Draw the scene without the pull."""
        if self._stepping is not None:
            wait([self._stepping])
        base = self._base
        if base is not None and base[0] is self._engine():
            base[0].adopt(base[1], base[2])
            work = self._store.get()
            live = tuple(layer for layer in work.transient.live if layer.gdf < len(base[2]))
            self._store.replace(with_transient(work, live=live))
        self._forget()
        self._store.wake()

    def _forget(self) -> None:
        """Forget the edit in progress, which is not drawn any more."""
        self._base = self._prepared = self._solved = self._stepping = self._refused = None
        pull = self._pull
        if pull is not None and pull.edit is not None:
            self._set(replace(pull, edit=None, influence=None))

    def _keep(self) -> None:
        """Begin to make the layer in another thread."""
        pull = self._pull
        problem = None if pull is None else self._problem(pull)
        if pull is None or problem is None or not any(handle.moves for handle in pull.pose.handles):
            self._leave()
            return
        self._maker.check_free()
        original = self._documents.get().original
        bases = self._bases

        def make(name: str, path: Path, _: Progress) -> None:
            _make_layer(bases, problem, pull.pose, original, name, path)

        def done(is_ready: bool) -> None:
            self._keeping = False
            if is_ready:
                self._clear()
            elif self._store.get().transient.gizmo is None:
                self._set(pull)

        self._set(None)
        self._keeping = True
        try:
            self._maker.begin(_NAME, make, done, self._builder)
        except (ProgdfError, OSError):
            done(False)
            raise


def _pose(pull: Pull) -> HandlePose:
    """Return the pose of the tool's handles."""
    handles = pull.pose.handles
    turns = [handle.turn or (0.0, 0.0, 0.0) for handle in handles]
    return HandlePose(
        np.array([handle.pull for handle in handles], np.float64).reshape(-1, 3),
        np.array(turns, np.float64).reshape(-1, 3),
        np.array([handle.scale for handle in handles], np.float64),
    )


def _point_pose(pose: HandlePose, owners: NDArray[np.int64]) -> HandlePose:
    """Return the pose of the constrained points of a problem."""
    return HandlePose(pose.pulls[owners], pose.turns[owners], pose.scales[owners])


def _stack(problem: _Problem) -> list[Layer]:
    return [
        layer_of(problem.gdfs[layer.gdf], layer.strength, layer.gains, layer.paint, layer.blend)
        for layer in problem.layers
    ]


@one_thread()
def _prepare(bases: _Bases, problem: _Problem, pose: HandlePose, count: int) -> _Prepared:
    """Build the graph, the edit in progress near its first pose, and its composer.

    Args:
        bases: cache of the scene under the layers
        problem: what is pulled
        pose: pose of the tool's handles
        count: number of the scene's own Gaussians

    Raises:
        ProgdfError: a handle is held, or is not on the part.
    """
    scene = bases.scene(problem, count)
    handles, hold, is_cut = _constraints(bases, problem, scene)
    cuts = _lines(problem.cuts)
    gripped, owners = with_grips(scene, handles, hold, cuts)
    live = LivePull(scene, gripped, hold, cuts=cuts)
    first = live.step(_point_pose(pose, owners), _FIRST_ROUNDS)
    drawn = problem.engine.scene
    edit = edit_in_progress(drawn, live.members, live.channels, _NAME)

    frame = rest_frame(drawn, _stack(problem), problem.blend, torch.from_numpy(live.members))
    write_offsets(edit, _rest_offsets(frame, first.offsets))
    composer = Composer(drawn, (*problem.gdfs, edit))
    stack = _stack(problem)
    for layers in ([*stack, Layer(edit)], stack):  # the first one compiles and plans the steps to come
        composer.update(layers, problem.blend)
    return _Prepared(problem, owners, live, edit, composer, is_cut or live.cut_count > 0, frame)


def _rest_offsets(frame: RestFrame | None, offsets: Tensor) -> Tensor:
    """Return offsets of the scene on screen as offsets that its moves carry. [M,C] -> [M,C]"""
    return offsets if frame is None else frame.offsets(offsets)


@one_thread()
def _solve(live: LivePull, pose: HandlePose) -> LiveStep:
    return live.step(pose, _ROUNDS)


@one_thread()
def _make_layer(
    bases: _Bases, problem: _Problem, pose: PullPose, original: Gaussians, name: str, path: Path
) -> None:
    """Solve the whole course and write it as an edit, as `progdf edit --pull` does."""
    scene = bases.scene(problem, len(original))
    handles, hold, _ = _constraints(bases, problem, scene)
    moved = [
        replace(handle, pull=placed.pull, turn=placed.turn, scale=placed.scale)
        for handle, placed in zip(handles, pose.handles, strict=True)
        if placed.moves
    ]
    cuts = _lines(problem.cuts)
    course = pull(scene, with_grips(scene, moved, hold, cuts)[0], hold, cuts=cuts)
    members = course.region.members
    frame = rest_frame(problem.engine.scene, _stack(problem), problem.blend, members)
    offsets = torch.stack([_rest_offsets(frame, each) for each in course.offsets])
    course = replace(course, offsets=offsets)
    save_gdf(path, tidy(original, [Step("pull", course.region, course=course)], name, "pull"))


def _constraints(
    bases: _Bases, problem: _Problem, scene: Gaussians
) -> tuple[list[Handle], Region | None, bool]:
    """Return the handles at rest, the held region, and True if cuts make the handles' region smaller."""
    count = len(scene)
    mask = np.ones(count, bool)
    if problem.limit != selection.EMPTY_MASK:
        mask = _own(problem.limit, problem, count)
    if problem.hidden != selection.EMPTY_MASK:
        mask &= ~_own(problem.hidden, problem, count)
    if not mask.any():
        raise ProgdfError("the selection has no Gaussian of the scene; select a part, or nothing")
    means = scene.means.double().numpy()
    allowed = np.flatnonzero(mask)
    tree = PointTree(means[allowed], _PIN_GAUSSIANS)
    region = from_mask(_NAME, torch.from_numpy(mask))
    is_cut = False
    if problem.radius is None and problem.limit == selection.EMPTY_MASK:
        nearest = allowed[tree.query(np.array(problem.points), 1)[1][:, 0]]
        region = bases.connected_part(scene, mask, nearest, problem.cuts)
        is_cut = len(region) < len(bases.connected_part(scene, mask, nearest, ()))
    held = np.zeros(count, bool)
    if problem.held != selection.EMPTY_MASK:
        held |= _own(problem.held, problem, count)
    if problem.pins:
        near = tree.query(np.array(problem.pins), min(_PIN_GAUSSIANS, len(allowed)))[1]
        held[allowed[near.ravel()]] = True
    still = (0.0, 0.0, 0.0)
    handles = [
        Handle(region, point, still, problem.radius, still if framed else None)
        for point, framed in zip(problem.points, problem.framed, strict=True)
    ]
    hold = from_mask("held", torch.from_numpy(held)) if held.any() else None
    return handles, hold, is_cut


def _lines(cuts: tuple[PullCut, ...]) -> Cuts:
    return Cuts(lines=tuple(CutLine(np.array(cut.eye), np.array(cut.points)) for cut in cuts))


def _own(packed: bytes, problem: _Problem, count: int) -> NDArray[np.bool_]:
    """Return a packed mask for the scene's own Gaussians. [N]"""
    own: NDArray[np.bool_] = selection.unpack(packed, len(problem.engine.scene))[:count].copy()
    return own
