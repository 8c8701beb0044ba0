"""Pictures of moving sliders: animations, films of a timeline, contact sheets of one slider or two."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.io import images
from progdf.io.atomic import atomic_write, is_temporary, remove_abandoned, write_error, write_files_together
from viewer.camera.view_camera import to_camera
from viewer.render.engine import ViewEngine
from viewer.state import timeline
from viewer.state.view_state import Timeline, ViewState

Pixels = NDArray[np.uint8]
Draw = Callable[[ViewState], NDArray[np.float32]]

VIDEO = ".mp4"
_VIDEO_COLORS = {
    "colorspace": "bt709",
    "color_primaries": "bt709",
    "color_trc": "iec61966-2-1",
    "color_range": "tv",
}
"""Tags that tell a player how colors are encoded: matrix and primaries of HD video, the curve of sRGB."""
_VIDEO_FILTER = (
    "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+full_chroma_int,format=yuv420p,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1:range=tv"
)
"""Converts to these colors. Newer encoders take the tags from the frames, older ones from their options."""

_WEBP_QUALITY = 85  # of 100: no block is seen in a still
_PALETTE_REACH = 8  # levels: Pillow looks up the nearest color of a palette in steps of 4
ANIMATIONS = (".gif", ".webp", VIDEO)
_OPAQUE = (".gif", VIDEO)  # a .gif has no partial transparency
SHEET_STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)


def to_pixels(image: NDArray[np.float32]) -> Pixels:
    """Return an image of 0..1 as 0..255, rounded; values beyond are clipped."""
    return np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def transparent_image(engine: ViewEngine, view: ViewState, camera: Camera) -> Pixels:
    """Return the view with its coverage as alpha, the colors not multiplied by it. [H,W,4]"""
    black = engine.image(replace(view, background=(0.0, 0.0, 0.0)), camera=camera).copy()
    white = engine.image(replace(view, background=(1.0, 1.0, 1.0)), camera=camera)
    return unmix(black, white)


def unmix(black: NDArray[np.float32], white: NDArray[np.float32]) -> Pixels:
    """Return the color and alpha of a picture by its renders on black and on white.

    [H,W,3] twice -> [H,W,4]
    """
    alpha = np.clip(1.0 - (white - black).mean(axis=-1, keepdims=True), 0.0, 1.0)
    color = np.clip(black / np.maximum(alpha, 1e-6), 0.0, 1.0)
    return to_pixels(np.concatenate([color, alpha], axis=-1))


def with_strengths(view: ViewState, strengths: dict[str, float]) -> ViewState:
    """`view` with the named layers at these strengths, and shown, in groups that are shown."""
    moved = tuple(
        replace(l, strength=strengths[l.name], enabled=True) if l.name in strengths else l
        for l in view.layers
    )
    enabled = {layer.group for layer in moved if layer.name in strengths}
    groups = tuple(replace(group, enabled=group.enabled or group.name in enabled) for group in view.groups)
    return replace(view, layers=moved, groups=groups)


def contact_sheet(names: Sequence[str], draw: Draw, view: ViewState) -> Pixels:
    """`view` with a layer at five strengths, in a row; of a second one too, from row to row the first."""
    *down, across = names
    rows: list[dict[str, float]] = [dict.fromkeys(down, s) for s in (SHEET_STRENGTHS if down else (0.0,))]
    drawn = [
        [torch.from_numpy(draw(with_strengths(view, row | {across: s}))) for s in SHEET_STRENGTHS]
        for row in rows
    ]
    labels = [f"{name} {s:g}" for row in rows for name, s in row.items()]
    columns = [f"{across} {s:g}" for s in SHEET_STRENGTHS]
    return to_pixels(images.contact_sheet(drawn, labels, columns).numpy())


def write_film(path: Path, frames: Iterable[Pixels], frames_per_second: int) -> None:
    """Write frames as they come, each for the same time: .gif or .webp, endless, or .mp4.

    Frames are [H,W,3], of a .webp also [H,W,4]. A .gif counts in hundredths of a second, so its frames take
    turns in being a little longer and shorter. No frame is shorter than 2, as programs slow such down.
    """
    if path.suffix.lower() == VIDEO:
        _encode_video(path, frames, frames_per_second)
        return
    prepared = _prepare(path, frames)
    ends = [round(100 * (i + 1) / frames_per_second) for i in range(len(prepared))]
    hundredths = [end - start for start, end in zip([0, *ends], ends, strict=False)]
    _save(path, prepared, [10 * max(2, each) for each in hundredths])


def write_sequence(folder: Path, frames: Iterable[Pixels]) -> None:
    """Write frames as frame_0000.png, frame_0001.png, …: all appear or none, see `write_files_together`.

    Raises:
        ProgdfError: see `check_sequence`; or the place cannot be written, or is full.
    """
    check_sequence(folder)
    with write_files_together(folder) as temporary:
        for number, frame in enumerate(frames):
            Image.fromarray(frame).save(temporary / f"frame_{number:04d}.png")


def check_sequence(folder: Path) -> None:
    """Raise ProgdfError if no folder of frames can be made: its place is taken, or its parent is missing."""
    remove_abandoned(folder)
    try:
        taken = os.path.lexists(folder) and (
            not folder.is_dir() or not all(is_temporary(path.name) for path in folder.iterdir())
        )
    except OSError as error:
        raise write_error(folder, error) from None
    if taken:
        raise ProgdfError(f"{folder} exists and is not an empty folder; give a new name for the frames")
    if not folder.absolute().parent.is_dir():
        raise ProgdfError(f"the folder {folder.absolute().parent} does not exist; create it first")


def _prepare(path: Path, frames: Iterable[Pixels]) -> list[Image.Image]:
    """Frames as pictures; for a .gif in one palette."""
    there = [Image.fromarray(frame) for frame in frames]
    if path.suffix.lower() != ".gif":
        return there
    few = there[:: max(1, len(there) // 4)]
    mosaic = Image.fromarray(np.concatenate([np.asarray(frame) for frame in few]))
    palette = _with_exact_background(mosaic, mosaic.quantize(256, method=Image.Quantize.MEDIANCUT))
    return [frame.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for frame in there]


def _save(path: Path, prepared: Sequence[Image.Image], durations: Sequence[int]) -> None:
    kind: dict[str, Any] = {"disposal": 1} if path.suffix.lower() == ".gif" else {"quality": _WEBP_QUALITY}
    more = list(prepared[1:])
    prepared[0].save(path, save_all=True, append_images=more, duration=list(durations), loop=0, **kind)


def _with_exact_background(picture: Image.Image, indexed: Image.Image) -> Image.Image:
    """The same palette, but what is nearly the commonest color becomes that color: white stays white."""
    counts = picture.getcolors(picture.width * picture.height) or []
    commonest = np.array(max(counts)[1])
    colors = np.array(indexed.getpalette(), np.int64).reshape(-1, 3)
    distances = np.abs(colors - commonest).max(axis=1)
    colors[distances <= max(_PALETTE_REACH, int(distances.min()))] = commonest
    indexed.putpalette(colors.ravel().tolist())
    return indexed


def check_encoder(path: Path) -> None:
    """Raise ProgdfError for an .mp4 if the package that encodes it is not installed."""
    if path.suffix.lower() == VIDEO and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ProgdfError(f"{path} needs a video encoder; pip install progdf-studio[video], or write a .gif")


def film_size(out: Path, camera: Camera) -> tuple[int, int]:
    """Return width and height of the film's frames in pixels; those of an .mp4 are even."""
    if out.suffix.lower() != VIDEO:
        return camera.width, camera.height
    return camera.width + camera.width % 2, camera.height + camera.height % 2


def _encode_video(path: Path, frames: Iterable[Pixels], frames_per_second: int) -> None:
    """Encode H.264 frame by frame, so that a long film needs no memory."""
    import imageio_ffmpeg  # an extra, see check_encoder

    tags = [word for tag, value in _VIDEO_COLORS.items() for word in (f"-{tag}", value)]
    writer = None
    for frame in frames:
        even = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")
        if writer is None:
            writer = imageio_ffmpeg.write_frames(
                str(path),
                (even.shape[1], even.shape[0]),
                fps=frames_per_second,
                quality=8,
                macro_block_size=2,
                output_params=["-vf", _VIDEO_FILTER, *tags],
            )
            writer.send(None)
        writer.send(np.ascontiguousarray(even))
    if writer is not None:
        writer.close()


Advance = Callable[[int, int], None]


def check_output(out: Path, alpha: bool = False) -> None:
    """Raise ProgdfError if `out` is no film, holds no transparency, or is no place for a folder of frames."""
    suffix = out.suffix.lower()
    if suffix not in (*ANIMATIONS, ""):
        raise ProgdfError(f"{out} cannot hold a film; write a .gif, a .webp, an .mp4 or a folder of frames")
    if alpha and suffix in _OPAQUE:
        raise ProgdfError(
            f"{out} cannot hold a transparent background; write a .webp or a folder of frames, "
            "or leave out --alpha"
        )
    if not suffix:
        check_sequence(out)


def frames(
    keys: Timeline,
    view: ViewState,
    still: Camera,
    engine: ViewEngine,
    numbers: Iterable[int],
    alpha: bool = False,
) -> Iterator[Pixels]:
    """Draw some frames. [H,W,3] each, [H,W,4] with alpha

    Args:
        keys: the keys
        view: what no key says: background, blend, edits that do not move
        still: gives the size, and the camera where no key has one
        engine: draws
        numbers: of the frames
        alpha: a transparent background
    """
    for frame in numbers:
        state = timeline.state_at(keys, frame, view)
        moving = timeline.camera_at(keys, frame) is not None
        camera = to_camera(state.camera, still.width, still.height) if moving else still
        if alpha:
            yield transparent_image(engine, state, camera)
        else:
            yield to_pixels(engine.image(state, camera=camera))


def sheet_frames(keys: Timeline, count: int) -> list[int]:
    """At most `count` frames from the first to the last, evenly; a way back shows none that are new."""
    steps = max(count - 1, 1)
    return sorted({round(i * keys.length / steps) for i in range(count)})


def write(
    out: Path,
    keys: Timeline,
    view: ViewState,
    still: Camera,
    engine: ViewEngine,
    advance: Advance | None = None,
    alpha: bool = False,
) -> str:
    """Write the film: .gif, .webp, .mp4, or a folder of .png files.

    Args:
        out: the file or folder
        keys, view, still, engine: see `frames`
        advance: receives how many frames of how many are drawn
        alpha: a transparent background

    Returns:
        A line for the person that names the film, its frames and their size.

    Raises:
        ProgdfError: see `check_output`.
    """
    check_output(out, alpha)
    numbers = [*timeline.film_frames(keys)]
    total = len(numbers)
    drawn = _count_frames(frames(keys, view, still, engine, numbers, alpha), total, advance)
    if out.suffix:
        with atomic_write(out) as temporary_file:
            write_film(temporary_file, drawn, keys.fps)
    else:
        write_sequence(out, drawn)
    width, height = film_size(out, still)
    return (
        f"wrote {out} ({total} frames of {width}x{height}, {keys.fps} a second, drawn by {engine.draws_with})"
    )


def _count_frames(drawn: Iterable[Pixels], total: int, advance: Advance | None) -> Iterator[Pixels]:
    for done, picture in enumerate(drawn, 1):
        yield picture
        if advance is not None:
            advance(done, total)
