"""`python -m benchmarks select`: what a selection by hand takes, on scenes up to a million."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.courses import processor_milliseconds
from benchmarks.table import Table, machine
from progdf.gaussians import Gaussians
from progdf.scene import selection as shapes
from progdf.scene.neighbors import Neighborhood, grow_along_surface
from progdf.terminal import group_digits
from viewer.camera.view_camera import first_camera, to_camera
from viewer.state import selection

from .scenes import copies, scenes_of

SIZE = (980, 800)
TIMES = 5
CORNERS = 400
"""Of the lasso: as many as a hand leaves in a few seconds."""


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure, for docs/benchmarks.md.

    Args:
        scenes: .ply files that take the place of the bears

    Raises:
        ProgdfError: a file is missing or broken.
    """
    opened = scenes_of(scenes)
    opened.append(copies(opened[-1], -(-1_000_000 // len(opened[-1]))))
    columns = [measure(scene) for scene in opened]
    rows = tuple((name, *(f"{times[name]:.0f}" for times in columns)) for name in columns[0])
    heads = tuple(group_digits(len(scene)) for scene in opened)
    note = f"Processor time in ms, median of {TIMES}, picture of {SIZE[0]}×{SIZE[1]}. {machine()}."
    return [Table("select", "A selection by hand", ("of Gaussians", *heads), rows, note)]


def measure(scene: Gaussians) -> dict[str, float]:
    """Milliseconds of the processor that each thing takes."""
    camera = to_camera(first_camera(scene), *SIZE)
    turn = np.linspace(0.0, 2.0 * np.pi, CORNERS, endpoint=False)
    reach = 300.0 * (1.0 + 0.2 * np.sin(7.0 * turn))
    outline = np.stack([SIZE[0] / 2 + reach * np.cos(turn), SIZE[1] / 2 + reach * np.sin(turn)], axis=1)
    centers = shapes.project_centers(scene, camera)
    ball = shapes.inside_ball(scene, scene.means.median(0).values.numpy(), 0.3)
    colors, near = shapes.base_colors(scene), Neighborhood(scene)
    seed = int(np.flatnonzero(ball)[0])

    ahead = shapes.Surface(scene, camera)
    ahead.prepare()

    def lasso(through: bool, surface: shapes.Surface | None = None) -> bytes:
        """From the mouse's release to the state: seen, enclosed, in front, packed."""
        surface = surface or shapes.Surface(scene, camera)
        mask = shapes.inside_polygon(surface.centers.points, outline)
        return selection.pack(mask if through else surface.in_front(mask))

    works: dict[str, Callable[[], object]] = {
        "lasso, through": lambda: lasso(True),
        "lasso, front surface, at once": lambda: lasso(False),
        "lasso, front surface, looked at ahead": lambda: lasso(False, ahead),
        "a step of the brush": lambda: shapes.inside_stroke(centers.points, outline[:2], 40.0),
        "colors": lambda: shapes.base_colors(scene),
        "flood": lambda: grow_along_surface(near, colors, np.array([seed]), colors[seed], 0.08),
        "neighborhood, once": lambda: Neighborhood(scene),
        "grow": lambda: near.grow(ball),
    }
    return {name: _median(work) for name, work in works.items()}


def _median(work: Callable[[], object]) -> float:
    work()
    return statistics.median(processor_milliseconds(work) for _ in range(TIMES))
