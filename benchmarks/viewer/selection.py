"""The benchmark `select`: time of manual selections in scenes of up to a million Gaussians."""

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

SIZE = (980, 800)  # pixels
TIMES = 5  # repetitions, of which the median counts
CORNERS = 400
"""Corners of the lasso, as many as a user draws in a few seconds."""


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure manual selections, for docs/benchmarks.md.

    Args:
        scenes: .ply files that replace the bears

    Raises:
        ProgdfError: a file is missing or broken.
    """
    opened = scenes_of(scenes)
    opened.append(copies(opened[-1], -(-1_000_000 // len(opened[-1]))))
    columns = [measure(scene) for scene in opened]
    rows = tuple((name, *(f"{times[name]:.0f}" for times in columns)) for name in columns[0])
    heads = tuple(group_digits(len(scene)) for scene in opened)
    note = f"Processor time in ms, median of {TIMES}, picture of {SIZE[0]}×{SIZE[1]}. {machine()}."
    return [Table("select", "Manual selections", ("operation / Gaussians", *heads), rows, note)]


def measure(scene: Gaussians) -> dict[str, float]:
    """Measure the processor time of each operation, ms."""
    camera = to_camera(first_camera(scene), *SIZE)
    angle = np.linspace(0.0, 2.0 * np.pi, CORNERS, endpoint=False)
    radius = 300.0 * (1.0 + 0.2 * np.sin(7.0 * angle))
    outline = np.stack([SIZE[0] / 2 + radius * np.cos(angle), SIZE[1] / 2 + radius * np.sin(angle)], axis=1)
    centers = shapes.project_centers(scene, camera)
    ball = shapes.inside_ball(scene, scene.means.median(0).values.numpy(), 0.3)
    colors, near = shapes.base_colors(scene), Neighborhood(scene)
    seed = int(np.flatnonzero(ball)[0])

    prepared = shapes.Surface(scene, camera)
    prepared.prepare()

    def lasso(through: bool, surface: shapes.Surface | None = None) -> bytes:
        """Compute a selection from the mouse release to the packed state."""
        surface = surface or shapes.Surface(scene, camera)
        mask = shapes.inside_polygon(surface.centers.points, outline)
        return selection.pack(mask if through else surface.in_front(mask))

    works: dict[str, Callable[[], object]] = {
        "lasso, through": lambda: lasso(True),
        "lasso, front surface, at once": lambda: lasso(False),
        "lasso, front surface prepared ahead": lambda: lasso(False, prepared),
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
