"""Which way is up in the window and in pictures: said, kept with an edit, or found in the scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.scene.up_axis import find_up, up_from_json

Vec3 = tuple[float, float, float]


def up_of(
    scene: Gaussians,
    gdfs: Sequence[Gdf] = (),
    path: Path | None = None,
    asked: str = "auto",
    cameras: Sequence[Camera] = (),
) -> Vec3:
    """The world direction that is up; unit length.

    Args:
        scene: the original
        gdfs: its edits, whose training may have known
        path: the scene's file
        asked: an axis, or "auto"
        cameras: given with the scene
    """
    kept = (up_from_json(gdf.report.get("up")) for gdf in gdfs) if asked == "auto" else ()
    found = next((up for up in kept if up is not None), None)
    if found is None:
        found = find_up(scene, cameras, asked).direction if len(scene) else None
    x, y, z = (0.0, 1.0, 0.0) if found is None else (float(c) for c in found)
    return x, y, z
