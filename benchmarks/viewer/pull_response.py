"""The benchmark `pull-response`: response times of the Pull tool.

It times whole frames of a whole window, drawn by the CPU, from the mouse's event to finished pixels.

    python -m benchmarks pull-response
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import moderngl
import numpy as np
import torch

from benchmarks.table import Table
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.terminal import group_digits
from progdf.threads import one_thread
from viewer.app.parts.edits import EditActions
from viewer.app.parts.making import LayerMaker
from viewer.app.parts.pulling import PullActions
from viewer.camera.decal_warp import project
from viewer.camera.view_camera import first_camera, to_camera
from viewer.files.document import Document, DocumentStore, LiveLayers
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state import selection
from viewer.state.transient import Pull
from viewer.state.view_state import ViewState
from viewer.state.workspace import with_transient

from .mouse import Mouse
from .scenes import copies, scenes_of

SIZE = (980, 800)  # pixels
MEMBERS = (1_000, 30_000, 300_000)  # Gaussians that are pulled
EVENTS = 40  # measured movements of the mouse
WARM_UP = 5  # movements before the measured ones
_POLL_S = 5e-4  # seconds between looks at a step in progress
STEP_PX = 5.0  # mouse movement from one event to the next, pixels


@dataclass(frozen=True)
class DraggingTimes:
    """Response times of one scene and number of pulled Gaussians, ms."""

    count: int  # Gaussians of the scene
    members: int  # pulled Gaussians
    nodes: int
    preparation: float  # from the press to the first deformed picture
    events: tuple[float, ...]  # from the event to finished pixels that show its displacement
    steps: tuple[float, ...]  # solving and moving the Gaussians
    compose: tuple[float, ...]  # adding the offsets to the layers below
    upload: tuple[float, ...]
    draw: tuple[float, ...]


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure the Pull tool, for docs/speed-and-error.md.

    Args:
        scenes: scene files that replace the bears

    Raises:
        ProgdfError: a file is missing or broken.
    """
    context = headless_context()
    found = scenes_of(scenes)
    found.append(copies(found[-1]))
    results = []
    for members in MEMBERS:
        scene = next((one for one in found if len(one) >= members), found[-1])
        results.append(measure(context, scene, members))
    context.release()
    rows = tuple(
        (
            group_digits(one.count),
            group_digits(one.members),
            group_digits(one.nodes),
            f"{one.preparation:.0f}",
            *(f"{np.median(part):.1f}" for part in (one.steps, one.compose, one.upload, one.draw)),
            f"**{np.median(one.events):.0f}** / {np.quantile(one.events, 0.95):.0f}",
        )
        for one in results
    )
    columns = (
        "Gaussians",
        "pulled",
        "nodes",
        "preparation, in the background",
        "solve and move",
        "compose",
        "upload",
        "draw",
        "event to pixels p50 / p95",
    )
    note = (
        f"Whole frames, from the mouse's event to finished pixels of picture and panel that show its "
        f"displacement. The handle moves by {STEP_PX:g} pixels per event, and the whole selection follows. "
        "The largest scene has several copies of the one before."
    )
    title = f"The Pull tool without a graphics card, {SIZE[0]}×{SIZE[1]}, ms"
    return [Table("pull-response", title, columns, rows, note)]


@one_thread()
def measure(
    context: moderngl.Context, scene: Gaussians, members: int, size: tuple[int, int] = SIZE
) -> DraggingTimes:
    """Measure one drag of a part of the scene.

    Args:
        context: GL context of the window
        scene: the scene
        members: number of Gaussians around the pulled point that can move
        size: size of the picture, pixels
    """
    engine = ViewEngine(context, scene, (), "cpu")
    view = ViewState(camera=first_camera(scene), axes=False)
    with Mouse(context, engine, scene, (), view, size) as mouse:
        actions = _pull_actions(mouse, scene)
        mouse.learn_detail()
        mouse.release()
        place = _middle(mouse, scene)
        distance = (scene.means - torch.tensor(place[1])).norm(dim=1)
        mask = np.zeros(len(scene), bool)
        mask[distance.argsort()[:members].numpy()] = True
        work = mouse.main_view.work
        selected = selection.select(work.view.selection, mask)
        mouse.main_view.store.change(replace(work.view, selection=selected))
        actions.requests["pull"](None)
        work = mouse.main_view.work
        pull = work.transient.gizmo
        assert isinstance(pull, Pull)
        mouse.main_view.store.replace(with_transient(work, gizmo=replace(pull, whole=True)))
        mouse.move(*place[0])
        mouse.frame(seconds=1.0)
        began = time.perf_counter()
        mouse.press()
        x, y = place[0]
        mouse.move(x + STEP_PX, y)
        _wait_shown(mouse, actions)
        preparation = 1e3 * (time.perf_counter() - began)
        timings = []
        events = []
        for k in range(WARM_UP + EVENTS):
            began = time.perf_counter()
            mouse.move(x + (2 + k) * STEP_PX, y - k)
            _wait_shown(mouse, actions)
            events.append(1e3 * (time.perf_counter() - began))
            shown = actions.last_step
            assert shown is not None
            timings.append((shown.milliseconds, mouse.main_view.canvas.timings))
        moved, nodes = actions.size
        mouse.release()
        actions.close()
    engine.release()
    return DraggingTimes(
        count=len(scene),
        members=moved,
        nodes=nodes,
        preparation=preparation,
        events=tuple(events[WARM_UP:]),
        steps=tuple(step for step, _ in timings[WARM_UP:]),
        compose=tuple(one.compose_ms for _, one in timings[WARM_UP:]),
        upload=tuple(one.upload_ms for _, one in timings[WARM_UP:]),
        draw=tuple(one.draw_ms for _, one in timings[WARM_UP:]),
    )


def _pull_actions(mouse: Mouse, scene: Gaussians) -> PullActions:
    """Return the part of the window that pulls."""
    main_view = mouse.main_view

    def draw(_: Document, __: tuple[Gdf, ...], ___: LiveLayers) -> None:
        raise AssertionError("the benchmark makes no layer")

    documents = DocumentStore(Document("scene.ply", scene), draw)
    edits = EditActions(store=main_view.store, documents=documents, messages=main_view.messages)
    maker = LayerMaker(
        store=main_view.store,
        documents=documents,
        messages=main_view.messages,
        edits=edits,
        wake=lambda: None,
    )
    actions = PullActions(
        store=main_view.store,
        documents=documents,
        maker=maker,
        engine=lambda: main_view.engine,
        wake=lambda: None,
    )
    main_view.follow_input = actions.follow
    return actions


def _middle(mouse: Mouse, scene: Gaussians) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Return the window position of a visible Gaussian near the middle of the picture, and its center."""
    camera = to_camera(mouse.main_view.work.view.camera, *mouse.size)
    pixels, depths = project(scene.means.double().numpy(), camera)
    away = np.linalg.norm(pixels - np.array(mouse.size) / 2, axis=1)
    near = np.flatnonzero((away < 30.0) & (depths > 0.0))
    row = int(near[depths[near].argmin()])
    x, y = pixels[row].tolist()
    a, b, c = scene.means[row].tolist()
    return (x, y), (a, b, c)


def _wait_shown(mouse: Mouse, actions: PullActions) -> None:
    """Draw frames until the picture shows the displacement of the handles."""
    while True:
        pull = mouse.main_view.work.transient.gizmo
        assert isinstance(pull, Pull)
        wanted = [handle.pull for handle in pull.pose.handles]
        shown = actions.last_step
        if shown is not None and np.array_equal(shown.pose.pulls, np.array(wanted)):
            return
        actions.poll()
        if actions.last_step is shown:
            time.sleep(_POLL_S)
        else:
            mouse.frame()
