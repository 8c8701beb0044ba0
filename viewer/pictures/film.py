"""Pictures of moving sliders: animations, films of a timeline, contact sheets of one or two sliders."""

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
from progdf.system.packages import install_extra
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
"""Color tags for players: matrix and primaries of HD video, the curve of sRGB."""
_VIDEO_FILTER = (
    "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+full_chroma_int,format=yuv420p,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=iec61966-2-1:range=tv"
)
"""Filter that converts to these colors. Newer encoders read the tags from frames, older ones from options."""

_WEBP_QUALITY = 85  # 0 to 100; a paused frame shows no blocks
_PALETTE_REACH = 8  # levels: Pillow finds the nearest palette color in steps of 4
ANIMATIONS = (".gif", ".webp", VIDEO)
_OPAQUE_FORMATS = (".gif", VIDEO)  # a .gif has no partial transparency
SHEET_STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)


def to_pixels(image: NDArray[np.float32]) -> Pixels:
    """Return an image of 0..1 as 0..255, rounded; values beyond are clipped."""
    return np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def transparent_image(engine: ViewEngine, view: ViewState, camera: Camera) -> Pixels:
    """Return the view with its coverage as alpha, and colors not premultiplied by it. [H,W,4]"""
    black = engine.image(replace(view, background=(0.0, 0.0, 0.0)), camera=camera).copy()
    white = engine.image(replace(view, background=(1.0, 1.0, 1.0)), camera=camera)
    return unmix(black, white)


def unmix(black: NDArray[np.float32], white: NDArray[np.float32]) -> Pixels:
    """Return the color and alpha of a picture from its renders on black and on white.

    [H,W,3] twice -> [H,W,4]
    """
    alpha = np.clip(1.0 - (white - black).mean(axis=-1, keepdims=True), 0.0, 1.0)
    color = np.clip(black / np.maximum(alpha, 1e-6), 0.0, 1.0)
    return to_pixels(np.concatenate([color, alpha], axis=-1))


def with_strengths(view: ViewState, strengths: dict[str, float]) -> ViewState:
    """Return `view` with the named layers and their groups enabled, at these strengths."""
    moved = tuple(
        replace(l, strength=strengths[l.name], enabled=True) if l.name in strengths else l
        for l in view.layers
    )
    enabled = {layer.group for layer in moved if layer.name in strengths}
    groups = tuple(replace(group, enabled=group.enabled or group.name in enabled) for group in view.groups)
    return replace(view, layers=moved, groups=groups)


def contact_sheet(names: Sequence[str], draw: Draw, view: ViewState) -> Pixels:
    """Return `view` with a layer at five strengths in a row; with two layers, the first changes between
    rows."""
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
    """Write frames of equal duration as they arrive: looping .gif or .webp, or .mp4.

    Frames are [H,W,3], for a .webp also [H,W,4]. A .gif has durations in hundredths of a second, so its
    frames alternate between slightly longer and shorter ones. No frame is shorter than 2 hundredths, as
    programs slow such frames down.
    """
    if path.suffix.lower() == VIDEO:
        _encode_video(path, frames, frames_per_second)
        return
    prepared = _prepare(path, frames)
    ends = [round(100 * (i + 1) / frames_per_second) for i in range(len(prepared))]
    hundredths = [end - start for start, end in zip([0, *ends], ends, strict=False)]
    _save(path, prepared, [10 * max(2, each) for each in hundredths])


def write_sequence(folder: Path, frames: Iterable[Pixels]) -> None:
    """Write frames as frame_0000.png, frame_0001.png, …: all or none appear, see `write_files_together`.

    Raises:
        ProgdfError: see `check_sequence`; or the folder cannot be written, or the disk is full.
    """
    check_sequence(folder)
    with write_files_together(folder) as temporary:
        for number, frame in enumerate(frames):
            Image.fromarray(frame).save(temporary / f"frame_{number:04d}.png")


def check_sequence(folder: Path) -> None:
    """Raise ProgdfError if no folder of frames can be made: its path is taken, or its parent is missing."""
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
    """Return frames as Pillow images; for a .gif in one palette."""
    pictures = [Image.fromarray(frame) for frame in frames]
    if path.suffix.lower() != ".gif":
        return pictures
    sample = pictures[:: max(1, len(pictures) // 4)]
    mosaic = Image.fromarray(np.concatenate([np.asarray(frame) for frame in sample]))
    palette = _with_exact_background(mosaic, mosaic.quantize(256, method=Image.Quantize.MEDIANCUT))
    return [frame.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for frame in pictures]


def _save(path: Path, prepared: Sequence[Image.Image], durations: Sequence[int]) -> None:
    kind: dict[str, Any] = {"disposal": 1} if path.suffix.lower() == ".gif" else {"quality": _WEBP_QUALITY}
    remaining = list(prepared[1:])
    prepared[0].save(path, save_all=True, append_images=remaining, duration=list(durations), loop=0, **kind)


def _with_exact_background(picture: Image.Image, indexed: Image.Image) -> Image.Image:
    """Replace palette colors close to the most common color by that color, so that white stays white."""
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
        raise ProgdfError(f"{path} needs a video encoder; {install_extra('video')}, or write a .gif")


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
    """Raise ProgdfError if `out` is not a film, cannot hold transparency, or cannot be a folder of frames."""
    suffix = out.suffix.lower()
    if suffix not in (*ANIMATIONS, ""):
        raise ProgdfError(f"{out} cannot hold a film; write a .gif, a .webp, an .mp4 or a folder of frames")
    if alpha and suffix in _OPAQUE_FORMATS:
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
    """Draw some frames and yield them. [H,W,3] each, [H,W,4] with alpha

    Args:
        keys: the timeline
        view: the state that no key sets: background, blend, edits that do not move
        still: size of the frames, and the camera if no key has one
        engine: draws the frames
        numbers: numbers of the frames
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
    """Return at most `count` evenly spaced frames from first to last. The return of a ping-pong adds none."""
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
        advance: receives the number of drawn frames and the total
        alpha: a transparent background

    Returns:
        A line for the user with the film's path, frames and size.

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
