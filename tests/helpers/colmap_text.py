"""COLMAP text models, written without pycolmap."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

PINHOLE = "1 PINHOLE 640 480 500 501 320 240"


def write_text_model(
    folder: Path,
    names: Sequence[str],
    *,
    points: str | None = "",
    header: str = "",
    cameras: Sequence[str] = (PINHOLE,),
) -> Path:
    """Write a model whose image N looks along z from (0, 0, −N). Return its folder.

    Args:
        names: names of the images
        points: the line of 2D points after each image; None omits it
        header: the first line of images.txt, if any
        cameras: lines of cameras.txt
    """
    folder.mkdir(parents=True)
    lines = [header] if header else []
    for number, name in enumerate(names, 1):
        lines.append(f"{number} 1 0 0 0 0 0 {number} 1 {name}")
        if points is not None:
            lines.append(points)
    (folder / "cameras.txt").write_text("\n".join(["# Camera list", *cameras, ""]), encoding="utf-8")
    (folder / "images.txt").write_text("\n".join([*lines, ""]), encoding="utf-8")
    return folder
