"""The benchmark `popping`: films of the moving picture compared with films of the sharp one.

Changes from one frame to the next that the sharp film does not have are popping: detail that appears and
disappears.

    python -m benchmarks popping
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.table import Table
from progdf.camera import Camera
from progdf.demo_scenes import room
from progdf.gaussians import Gaussians
from progdf.rasterize.screen import fill_screen
from progdf.scene.bounds import near_plane
from progdf.terminal import group_digits
from progdf.threads import one_thread
from viewer.camera.view_camera import ViewCamera, add_scaled, axes, bounds_of, eye, first_camera, to_camera
from viewer.render.cpu_renderer import CpuRenderer
from viewer.render.dynamic_resolution import BUDGETS, COARSE_PIXELS, drawn_size

from .scenes import copies, scenes_of

SIZE = (980, 800)  # pixels
FRAMES = 40
RESTS = 4  # stops before the film, which calibrate the level of detail
BLOCK = 16  # side of a block, pixels
TURN = 1.0  # rotation per frame, degrees
STEP = 0.004  # movement per frame, share of the scene's radius

WHITE = (1.0, 1.0, 1.0)
NO_ORDER = np.zeros(0, np.uint32)


@dataclass(frozen=True)
class Film:
    """Measurements of a path through a scene; differences are means of pictures of 0 to 255."""

    title: str
    count: int  # Gaussians of the scene
    limit: float  # largest error of a drawn node, pixels²
    sharp: float  # change from frame to frame of the sharp film
    moving: float  # change from frame to frame of the moving film
    apart: float  # difference between these changes
    blocks: float  # the same for means of 16×16 pixels, 99th percentile of all blocks and frames
    halved: float  # `blocks` for pictures of all Gaussians with the same small number of pixels
    db: float  # PSNR of the moving film against the sharp one, worst frame


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Draw and compare the films, for docs/speed-and-error.md.

    Args:
        scenes: .ply files that replace the bears
    """
    opened = scenes_of(scenes)
    inside = room(200_000).gaussians
    paths = [("an orbit", scene, turning) for scene in (*opened, copies(opened[-1], 8))]
    paths += [("turning in the room", inside, spinning), ("a walk through the room", inside, walking)]
    films = [film(title, scene, list(path(first_camera(scene), scene))) for title, scene, path in paths]
    return [table(films)]


def turning(camera: ViewCamera, scene: Gaussians) -> Iterator[ViewCamera]:
    """Yield cameras that orbit the pivot."""
    for frame in range(FRAMES):
        yield replace(camera, azimuth=camera.azimuth + TURN * frame)


def spinning(camera: ViewCamera, scene: Gaussians) -> Iterator[ViewCamera]:
    """Yield cameras that rotate at a fixed position."""
    for turned in turning(camera, scene):
        shift = add_scaled(eye(camera), (-1.0, eye(turned)))
        yield replace(turned, pivot=add_scaled(turned.pivot, (1.0, shift)))


def walking(camera: ViewCamera, scene: Gaussians) -> Iterator[ViewCamera]:
    """Yield cameras that move ahead and gradually turn to the side."""
    step = -STEP * bounds_of(scene).radius
    for frame, turned in enumerate(spinning(camera, scene)):
        yield replace(turned, pivot=add_scaled(turned.pivot, (step * frame, axes(camera).back)))


@one_thread()
def film(title: str, scene: Gaussians, views: Sequence[ViewCamera], size: tuple[int, int] = SIZE) -> Film:
    """Draw a film three times; the moving picture has the level of detail calibrated in this scene."""
    renderer, near = CpuRenderer(), near_plane(bounds_of(scene).radius)
    renderer.upload(scene)
    live = renderer._scene
    pyramid = renderer._scene.begin_pyramid().result()

    def draw(camera: Camera, pixels: int) -> NDArray[np.float32]:
        renderer.draw(replace(camera, near=near), WHITE, NO_ORDER, pixels)
        screen = np.empty((size[1], size[0], 4), np.uint8)
        fill_screen(renderer.pixels(), screen)
        return screen[::-1, :, :3].astype(np.float32)

    small = drawn_size(size, COARSE_PIXELS)
    for _ in range(RESTS):
        live._budget = BUDGETS[2]
        live._finest = live._max_finest
        draw(to_camera(views[0], *small), COARSE_PIXELS)
        draw(to_camera(views[0], *size), 1)
    if live._fitted is not None:
        live._fitted.result()
    draw(to_camera(views[0], *small), COARSE_PIXELS)
    draw(to_camera(views[0], *size), 1)
    limit = live._max_finest
    pyramid = live.begin_pyramid().result() if live._pyramid is None else live._pyramid.result()
    last = list[NDArray[np.float32]]()
    means = []
    blocks = []
    halved = []
    worst = 0.0
    for view in views:
        # fixed, independent of the frame time
        live._budget = BUDGETS[2]
        live._finest = limit
        pyramid.limit = limit
        moving = draw(to_camera(view, *small), COARSE_PIXELS)
        frames = [draw(to_camera(view, *size), 1), moving, draw(to_camera(view, *small), 1)]
        worst = max(worst, float(np.square(frames[0] - moving).mean()))
        if last:
            full, moved, half = (frame - before for frame, before in zip(frames, last, strict=True))
            means.append([float(np.abs(change).mean()) for change in (full, moved, moved - full)])
            blocks.append(_blocks(moved - full))
            halved.append(_blocks(half - full))
        last = frames
    blocks_p99, halved_p99 = (float(np.percentile(np.abs(parts), 99)) for parts in (blocks, halved))
    sharp, moving, apart = np.mean(means, axis=0).tolist()
    db = 10.0 * math.log10(255.0**2 / worst)
    return Film(
        title=title,
        count=len(scene),
        limit=limit,
        sharp=sharp,
        moving=moving,
        apart=apart,
        blocks=blocks_p99,
        halved=halved_p99,
        db=db,
    )


def _blocks(change: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the means of blocks. [H,W,3] -> [rows,columns]"""
    rows = change.shape[0] // BLOCK
    columns = change.shape[1] // BLOCK
    whole = change[: rows * BLOCK, : columns * BLOCK].mean(2)
    means: NDArray[np.float32] = whole.reshape(rows, BLOCK, columns, BLOCK).mean((1, 3))
    return means


def table(films: Sequence[Film]) -> Table:
    """Make a table with one row per film."""
    return Table.of(
        "popping",
        f"Films of moving pictures, {SIZE[0]}×{SIZE[1]}: changes from frame to frame, of 255",
        [
            {
                "path": film.title,
                "Gaussians": group_digits(film.count),
                "limit, pixels²": f"{film.limit:.1f}",
                "sharp film": f"{film.sharp:.2f}",
                "moving film": f"{film.moving:.2f}",
                "difference of the changes": f"{film.apart:.2f}",
                "blocks: 99th percentile": f"{film.blocks:.1f}",
                "of all Gaussians in as few pixels": f"{film.halved:.1f}",
                "PSNR, the worst frame, dB": f"{film.db:.1f}",
            }
            for film in films
        ],
        f"{FRAMES} frames, each {TURN:.0f}° apart. The level of detail of the moving picture is calibrated "
        "at a stop before the film, independent of the frame time. Changes that the sharp film does not have "
        f"are popping (or missing detail), given on average and for the means of {BLOCK}×{BLOCK} pixels.",
    )
