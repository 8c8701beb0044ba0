"""One slider moved from 0 to 1: as an animation, as a contact sheet; two sliders: as a grid."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from progdf import pictures
from progdf.errors import ProgdfError

from .state import ViewState

Pixels = NDArray[np.uint8]
Draw = Callable[[ViewState], Pixels]

SWEEP_STEPS = 24
FRAME_MS, HOLD_MS = 50, 600  # an animation rests at both ends
_PALETTE_REACH = 8  # levels: Pillow looks up the nearest colour of a palette in steps of 4
SHEET_STRENGTHS = (0.0, 0.25, 0.5, 0.75, 1.0)


def to_pixels(image: NDArray[np.float32]) -> Pixels:
    """0..1 to 0..255, rounded; what is brighter or darker is cut off."""
    return np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def with_strengths(view: ViewState, strengths: dict[str, float]) -> ViewState:
    """`view` with the named layers at these strengths."""
    layers = (
        replace(layer, strength=strengths.get(layer.name, layer.strength), enabled=True)
        if layer.name in strengths
        else layer
        for layer in view.layers
    )
    return replace(view, layers=tuple(layers))


def sweep(view: ViewState, name: str, steps: int = SWEEP_STEPS) -> Iterator[ViewState]:
    """`view` with layer `name` at 0, 1/steps, …, 1: steps + 1 states."""
    for step in range(steps + 1):
        yield with_strengths(view, {name: step / steps})


def contact_sheet(name: str, draw: Draw, view: ViewState) -> Pixels:
    """`view` with layer `name` at five strengths, in a row."""
    row = [draw(with_strengths(view, {name: s})) for s in SHEET_STRENGTHS]
    return _sheet([row], [], [f"{name} {s:g}" for s in SHEET_STRENGTHS])


def grid(down: str, across: str, draw: Draw, view: ViewState) -> Pixels:
    """`view` under two sliders: `down` grows from row to row, `across` from column to column."""
    rows = [
        [draw(with_strengths(view, {down: s, across: t})) for t in SHEET_STRENGTHS] for s in SHEET_STRENGTHS
    ]
    return _sheet(
        rows, [f"{down} {s:g}" for s in SHEET_STRENGTHS], [f"{across} {t:g}" for t in SHEET_STRENGTHS]
    )


def _sheet(rows: list[list[Pixels]], row_labels: list[str], column_labels: list[str]) -> Pixels:
    images = [[torch.from_numpy(picture).float() / 255.0 for picture in row] for row in rows]
    return to_pixels(pictures.contact_sheet(images, row_labels, column_labels).numpy())


def write_gif(path: Path, frames: Iterable[Pixels]) -> None:
    """An endless animation there and back again, with one palette for all frames so that nothing flickers.

    Args:
        path: a .gif file
        frames: from one end of the slider to the other. [H,W,3] each
    """
    there = [Image.fromarray(frame) for frame in frames]
    few = there[:: max(1, len(there) // 4)]
    mosaic = Image.fromarray(np.concatenate([np.asarray(frame) for frame in few]))
    palette = _with_exact_background(mosaic, mosaic.quantize(256, method=Image.Quantize.MEDIANCUT))
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for frame in there]
    shown = indexed + indexed[-2:0:-1]
    rests = {0, len(indexed) - 1}
    durations = [HOLD_MS if i in rests else FRAME_MS for i in range(len(shown))]
    shown[0].save(path, save_all=True, append_images=shown[1:], duration=durations, loop=0, disposal=1)


def _with_exact_background(picture: Image.Image, indexed: Image.Image) -> Image.Image:
    """The same palette, but what is nearly the commonest colour becomes that colour: white stays white."""
    counts = picture.getcolors(picture.width * picture.height) or []
    commonest = np.array(max(counts)[1])
    colours = np.array(indexed.getpalette(), np.int64).reshape(-1, 3)
    distances = np.abs(colours - commonest).max(axis=1)
    colours[distances <= max(_PALETTE_REACH, int(distances.min()))] = commonest
    indexed.putpalette(colours.ravel().tolist())
    return indexed


def check_encoder(path: Path) -> None:
    """Raises ProgdfError where an .mp4 is wanted and the package that encodes it is not installed."""
    if path.suffix.lower() == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ProgdfError(f"{path} needs a video encoder; pip install progdf-studio[video], or write a .gif")


def write_mp4(path: Path, frames: Iterable[Pixels], frames_per_second: int = 20) -> None:
    """A film there and back again, H.264; the codec wants even sides, so an odd last row is doubled."""
    import imageio_ffmpeg  # an extra, see check_encoder

    there = [np.pad(f, ((0, f.shape[0] % 2), (0, f.shape[1] % 2), (0, 0)), mode="edge") for f in frames]
    hold = round(HOLD_MS * frames_per_second / 1000)
    shown = [there[0]] * hold + there[1:-1] + [there[-1]] * hold + there[-2:0:-1]
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (there[0].shape[1], there[0].shape[0]),
        fps=frames_per_second,
        quality=8,
        macro_block_size=2,
    )
    writer.send(None)
    for frame in shown:
        writer.send(np.ascontiguousarray(frame))
    writer.close()
