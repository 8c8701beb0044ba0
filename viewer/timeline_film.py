"""The film of a timeline, frame by frame: what is written does not depend on how long a frame takes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.files import written_whole

from . import film, timeline
from .engine import Engine
from .state import Timeline, ViewState
from .turntable import to_camera


def check_output(out: Path) -> None:
    """Raises ProgdfError where `out` is neither a film nor a place for a folder of frames."""
    suffix = out.suffix.lower()
    if suffix not in (".gif", ".mp4", ""):
        raise ProgdfError(
            f"{out} cannot hold a film; --timeline writes a .gif, an .mp4 or a folder of frames"
        )
    if not suffix:
        film.check_sequence(out)


def frames(shown: Timeline, view: ViewState, still: Camera, engine: Engine) -> Iterator[film.Pixels]:
    """The pictures of one round. [H,W,3] each

    Args:
        shown: the keys
        view: what no key says: background, blend, edits that do not move
        still: gives the size, and the camera where no key has one
        engine: draws
    """
    for frame in timeline.film_frames(shown):
        state = timeline.shown_at(shown, frame, view)
        moving = timeline.camera_at(shown, frame) is not None
        camera = to_camera(state.camera, still.width, still.height) if moving else still
        yield film.to_pixels(engine.image(state, camera=camera))


def write(out: Path, shown: Timeline, view: ViewState, still: Camera, engine: Engine) -> str:
    """Write the film: .gif, .mp4, or a folder of .png files; gives a line that tells what was written.

    Raises:
        ProgdfError: see `check_output`.
    """
    check_output(out)
    drawn = frames(shown, view, still, engine)
    if out.suffix:
        with written_whole(out) as beside:
            film.write_film(beside, drawn, shown.fps)
    else:
        film.write_sequence(out, drawn)
    count = sum(1 for _ in timeline.film_frames(shown))
    size = f"{still.width}x{still.height}"
    return f"wrote {out} ({count} frames of {size}, {shown.fps} a second, drawn by {engine.draws_with})"
