"""The film of a timeline, frame by frame: what is written does not depend on how long a frame takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import torch
from PIL import Image

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.io import images
from progdf.io.atomic import atomic_write
from viewer.camera.view_camera import to_camera
from viewer.render.engine import ViewEngine
from viewer.state import timeline
from viewer.state.view_state import Timeline, ViewState

from . import film

Advance = Callable[[int, int], None]

MOST_SHOWN = 100
"""Pictures of a contact sheet."""


def check_output(out: Path) -> None:
    """Raises ProgdfError where `out` is neither a film nor a place for a folder of frames."""
    suffix = out.suffix.lower()
    if suffix not in (".gif", ".mp4", ""):
        raise ProgdfError(
            f"{out} cannot hold a film; --timeline writes a .gif, an .mp4 or a folder of frames"
        )
    if not suffix:
        film.check_sequence(out)


def frames(
    shown: Timeline, view: ViewState, still: Camera, engine: ViewEngine, numbers: Iterable[int]
) -> Iterator[film.Pixels]:
    """The pictures of some frames. [H,W,3] each

    Args:
        shown: the keys
        view: what no key says: background, blend, edits that do not move
        still: gives the size, and the camera where no key has one
        engine: draws
        numbers: of the frames
    """
    for frame in numbers:
        state = timeline.state_at(shown, frame, view)
        moving = timeline.camera_at(shown, frame) is not None
        camera = to_camera(state.camera, still.width, still.height) if moving else still
        yield film.to_pixels(engine.image(state, camera=camera))


def sheet_frames(shown: Timeline, count: int) -> list[int]:
    """At most `count` frames from the first to the last, evenly; a way back shows none that are new."""
    steps = max(count - 1, 1)
    return sorted({round(i * shown.length / steps) for i in range(count)})


def sheet(shown: Timeline, view: ViewState, still: Camera, engine: ViewEngine, count: int) -> film.Pixels:
    """A contact sheet of `count` frames, row by row, each with its number and its time. [H,W,3]"""
    numbers = sheet_frames(shown, count)
    drawn = [
        torch.from_numpy(picture).float() / 255.0 for picture in frames(shown, view, still, engine, numbers)
    ]
    said = [f"frame {number}, {number / shown.fps:.2f} s" for number in numbers]
    columns = math.ceil(math.sqrt(len(numbers)))
    rows = range(0, len(numbers), columns)
    page = images.contact_sheet(
        [drawn[i : i + columns] for i in rows], notes=[said[i : i + columns] for i in rows]
    )
    return film.to_pixels(page.numpy())


def write(
    out: Path,
    shown: Timeline,
    view: ViewState,
    still: Camera,
    engine: ViewEngine,
    count: int = 0,
    advance: Advance | None = None,
) -> str:
    """Write the film: .gif, .mp4, or a folder of .png files; or a contact sheet of `count` frames.

    `advance` hears how many frames of how many are drawn.

    Returns:
        A line that tells what was written.

    Raises:
        ProgdfError: see `check_output`.
    """
    size = f"{still.width}x{still.height}"
    if count:
        page = sheet(shown, view, still, engine, count)
        with atomic_write(out) as temporary_file:
            Image.fromarray(page).save(temporary_file)
        count = len(sheet_frames(shown, count))
        return f"wrote {out} ({count} pictures of {size}, drawn by {engine.draws_with})"
    check_output(out)
    total = sum(1 for _ in timeline.film_frames(shown))
    drawn = _counted(frames(shown, view, still, engine, timeline.film_frames(shown)), total, advance)
    if out.suffix:
        with atomic_write(out) as temporary_file:
            film.write_film(temporary_file, drawn, shown.fps)
    else:
        film.write_sequence(out, drawn)
    return f"wrote {out} ({total} frames of {size}, {shown.fps} a second, drawn by {engine.draws_with})"


def _counted(drawn: Iterable[film.Pixels], total: int, advance: Advance | None) -> Iterator[film.Pixels]:
    for done, picture in enumerate(drawn, 1):
        yield picture
        if advance is not None:
            advance(done, total)
