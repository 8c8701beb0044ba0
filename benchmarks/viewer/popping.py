"""`python -m benchmarks popping`: films of the moving picture beside those of the sharp one.

What changes from one frame to the next and does not in the sharp film is popping: detail that comes and
goes.
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
from viewer.render.dynamic_resolution import BUDGETS, COARSE, drawn_size

from .scenes import copies, scenes_of

SIZE = (980, 800)
FRAMES = 40
RESTS = 4
BLOCK = 16
TURN = 1.0
STEP = 0.004
"""Degrees of a frame, and what it goes ahead, of the scene's radius."""

WHITE = (1.0, 1.0, 1.0)
NO_ORDER = np.zeros(0, np.uint32)


@dataclass(frozen=True)
class Film:
    """A path through a scene; differences are means of a picture of 0..255."""

    title: str
    count: int  # Gaussians of the scene
    limit: float  # of what a node may lose, pixels²
    sharp: float  # from frame to frame of the sharp film
    moving: float  # of the moving one
    apart: float  # of what changes in the one and of what changes in the other
    blocks: float  # the same of means of 16×16 pixels, the 99th percentile of all blocks and frames
    halved: float  # that of pictures of all Gaussians in as few pixels
    db: float  # PSNR of the moving film to the sharp one, the worst frame


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Make the films, for docs/speed-and-error.md.

    Args:
        scenes: .ply files that take the place of the bears
    """
    opened = scenes_of(scenes)
    inside = room(200_000).gaussians
    paths = [("an orbit", scene, turning) for scene in (*opened, copies(opened[-1], 8))]
    paths += [("turning in the room", inside, spinning), ("a walk through the room", inside, walking)]
    films = [film(title, scene, list(path(first_camera(scene), scene))) for title, scene, path in paths]
    return [table(films)]


def turning(camera: ViewCamera, scene: Gaussians) -> Iterator[ViewCamera]:
    """Around what is looked at."""
    for frame in range(FRAMES):
        yield replace(camera, azimuth=camera.azimuth + TURN * frame)


def spinning(camera: ViewCamera, scene: Gaussians) -> Iterator[ViewCamera]:
    """On the spot."""
    for turned in turning(camera, scene):
        off = add_scaled(eye(camera), (-1.0, eye(turned)))
        yield replace(turned, pivot=add_scaled(turned.pivot, (1.0, off)))


def walking(camera: ViewCamera, scene: Gaussians) -> Iterator[ViewCamera]:
    """Ahead, looking to the side by and by."""
    step = -STEP * bounds_of(scene).radius
    for frame, turned in enumerate(spinning(camera, scene)):
        yield replace(turned, pivot=add_scaled(turned.pivot, (step * frame, axes(camera).back)))


@one_thread()
def film(title: str, scene: Gaussians, views: Sequence[ViewCamera], size: tuple[int, int] = SIZE) -> Film:
    """Draw a film three times; the moving picture is as fine as it is found to need to be in this scene."""
    renderer, near = CpuRenderer(), near_plane(bounds_of(scene).radius)
    renderer.upload(scene)
    live = renderer._scene
    pyramid = renderer._scene.begin_pyramid().result()

    def draw(camera: Camera, pixels: int) -> NDArray[np.float32]:
        renderer.draw(replace(camera, near=near), WHITE, NO_ORDER, pixels)
        screen = np.empty((size[1], size[0], 4), np.uint8)
        fill_screen(renderer.pixels(), screen)
        return screen[::-1, :, :3].astype(np.float32)

    small = drawn_size(size, COARSE)
    for _ in range(RESTS):
        live._budget = BUDGETS[2]
        live._finest = live._max_finest
        draw(to_camera(views[0], *small), COARSE)
        draw(to_camera(views[0], *size), 1)
    limit = live._max_finest
    last = list[NDArray[np.float32]]()
    means = []
    blocks = []
    halved = []
    worst = 0.0
    for view in views:
        # whatever frames take
        live._budget = BUDGETS[2]
        live._finest = limit
        pyramid.limit = limit
        moving = draw(to_camera(view, *small), COARSE)
        frames = [draw(to_camera(view, *size), 1), moving, draw(to_camera(view, *small), 1)]
        worst = max(worst, float(np.square(frames[0] - moving).mean()))
        if last:
            full, moved, half = (frame - before for frame, before in zip(frames, last, strict=True))
            means.append([float(np.abs(change).mean()) for change in (full, moved, moved - full)])
            blocks.append(_blocks(moved - full))
            halved.append(_blocks(half - full))
        last = frames
    most, least = (float(np.percentile(np.abs(parts), 99)) for parts in (blocks, halved))
    sharp, moving, apart = np.mean(means, axis=0).tolist()
    db = 10.0 * math.log10(255.0**2 / worst)
    return Film(
        title=title,
        count=len(scene),
        limit=limit,
        sharp=sharp,
        moving=moving,
        apart=apart,
        blocks=most,
        halved=least,
        db=db,
    )


def _blocks(change: NDArray[np.float32]) -> NDArray[np.float32]:
    """The means of blocks. [H,W,3] -> [rows,columns]"""
    rows = change.shape[0] // BLOCK
    columns = change.shape[1] // BLOCK
    whole = change[: rows * BLOCK, : columns * BLOCK].mean(2)
    means: NDArray[np.float32] = whole.reshape(rows, BLOCK, columns, BLOCK).mean((1, 3))
    return means


def table(films: Sequence[Film]) -> Table:
    """A row a film."""
    return Table.of(
        "popping",
        f"Films of moving pictures, {SIZE[0]}×{SIZE[1]}: what changes from frame to frame, of 255",
        [
            {
                "path": film.title,
                "Gaussians": group_digits(film.count),
                "limit, pixels²": f"{film.limit:.1f}",
                "sharp film": f"{film.sharp:.2f}",
                "moving film": f"{film.moving:.2f}",
                "what changes apart": f"{film.apart:.2f}",
                "blocks: 99th percentile": f"{film.blocks:.1f}",
                "of all Gaussians in as few pixels": f"{film.halved:.1f}",
                "PSNR, the worst frame, dB": f"{film.db:.1f}",
            }
            for film in films
        ],
        f"{FRAMES} frames, each {TURN:.0f}° on. The moving picture is as fine as it is found to need to be "
        "where the hand rests before, whatever time that takes; what changes in it and does not in the sharp "
        f"film is popping (or detail that it lacks), on average and of the means of {BLOCK}×{BLOCK} pixels.",
    )
