"""Make assets/hero.webp, the moving picture of the README: sliders on trained scenes.

    python assets/hero_film.py OUT.webp SCENE EDIT.gdf LABEL [SCENE EDIT.gdf LABEL …]

Each scene turns slowly while its slider moves from 0 to 1 and back. The picture in the repository shows
PLAYBOT by Stephane Agullo and a card box by Marcel Padilla, both CC-BY-4.0.
"""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont

import progdf
from viewer.camera.view_camera import first_camera, to_camera

SIZE = (600, 430)  # pixels
FRAMES = 30  # of each scene
FRAME_MS = 80
TURN_DEG = 24.0  # the camera turns by so much to either side
MAX_BYTES = 2_000_000
QUALITIES = (72, 64, 56, 48, 40, 32)
TRACK = (150, 450)  # left and right end of the slider, pixels
TRACK_Y = 404
SUPERSAMPLING = 2  # of the slider's shapes
ACCENT = (42, 99, 212)
INK = (40, 40, 44)
TRACK_COLOR = (205, 208, 214)


@dataclass(frozen=True)
class Shot:
    """One scene with its edit."""

    scene: progdf.Gaussians
    gdf: progdf.Gdf
    label: str


def load_shot(scene_path: Path, gdf_path: Path, label: str) -> Shot:
    """Open a scene and an edit of it."""
    scene = progdf.load_scene(scene_path)
    return Shot(scene, progdf.load_gdf(gdf_path, scene), label)


def draw_frames(shot: Shot) -> Iterator[Image.Image]:
    """Yield the frames of one scene; the last one leads back to the first."""
    width, height = SIZE
    view = first_camera(shot.scene, aspect=width / height)
    for index in range(FRAMES):
        phase = 2.0 * math.pi * index / FRAMES
        share = 0.5 - 0.5 * math.cos(phase)
        strength = share * share * (3.0 - 2.0 * share)  # slow at both ends
        turned = replace(view, azimuth=view.azimuth + TURN_DEG * math.sin(phase))
        edited = progdf.compose_layers(shot.scene, [progdf.Layer(shot.gdf, strength)])
        with torch.no_grad():
            image = progdf.render(edited, to_camera(turned, width, height), background=(1.0, 1.0, 1.0)).image
        pixels = (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
        yield draw_slider(Image.fromarray(pixels), shot.label, strength)


def draw_slider(picture: Image.Image, label: str, strength: float) -> Image.Image:
    """Return a picture with a slider over its lower edge."""
    scale = SUPERSAMPLING
    large = picture.resize((picture.width * scale, picture.height * scale), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(large, "RGBA")
    left, right = (x * scale for x in TRACK)
    y = TRACK_Y * scale
    handle = left + (right - left) * strength
    draw.rounded_rectangle(
        (90 * scale, y - 22 * scale, 510 * scale, y + 20 * scale), 12 * scale, (255, 255, 255, 215)
    )
    draw.line((left, y, right, y), TRACK_COLOR, 5 * scale)
    draw.line((left, y, handle, y), ACCENT, 5 * scale)
    draw.ellipse(
        (handle - 8 * scale, y - 8 * scale, handle + 8 * scale, y + 8 * scale), ACCENT, "white", 2 * scale
    )
    font = ImageFont.load_default(14 * scale)
    draw.text((left - 12 * scale, y), label, INK, font, anchor="rm")
    draw.text((right + 12 * scale, y), f"{strength:.2f}", INK, font, anchor="lm")
    return large.resize(picture.size, Image.Resampling.LANCZOS)


def encode(frames: list[Image.Image]) -> bytes:
    """Return an animated WebP at the highest quality that fits into `MAX_BYTES`."""
    data = b""
    for quality in QUALITIES:
        file = io.BytesIO()
        frames[0].save(
            file,
            "WEBP",
            save_all=True,
            append_images=frames[1:],
            duration=FRAME_MS,
            loop=0,
            quality=quality,
            method=6,
        )
        data = file.getvalue()
        if len(data) <= MAX_BYTES:
            break
    return data


def main(words: list[str]) -> None:
    """Draw all shots and write the film."""
    out, *given = words
    frames: list[Image.Image] = []
    for index in range(0, len(given), 3):
        scene, gdf, label = given[index : index + 3]
        frames += draw_frames(load_shot(Path(scene), Path(gdf), label))
    data = encode(frames)
    Path(out).write_bytes(data)
    print(f"{out}: {len(frames)} frames, {len(data) / 1e6:.2f} MB")


if __name__ == "__main__":
    main(sys.argv[1:])
