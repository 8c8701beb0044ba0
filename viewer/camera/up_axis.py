"""Which way is up in the window and in pictures: said, kept with an edit, or found in the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.scene.up_axis import find_up, up_from_json

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class SceneUp:
    """The world direction that is up, unit length, and whether that is more than what most scenes have."""

    direction: Vec3
    certain: bool


def up_of(
    scene: Gaussians,
    gdfs: Sequence[Gdf] = (),
    asked: str = "auto",
    cameras: Sequence[Camera] = (),
) -> Vec3:
    """The direction of `find_scene_up`."""
    return find_scene_up(scene, gdfs, asked, cameras).direction


def find_scene_up(
    scene: Gaussians, gdfs: Sequence[Gdf] = (), asked: str = "auto", cameras: Sequence[Camera] = ()
) -> SceneUp:
    """Which way is up.

    Args:
        scene: the original
        gdfs: its edits, whose training may have known
        asked: an axis, or "auto"
        cameras: given with the scene
    """
    kept = (up_from_json(gdf.report.get("up")) for gdf in gdfs) if asked == "auto" else ()
    known = next((up for up in kept if up is not None), None)
    found = find_up(scene, cameras, asked) if known is None and len(scene) else None
    if found is not None:
        known = found.direction
    x, y, z = (0.0, 1.0, 0.0) if known is None else (float(c) for c in known)
    return SceneUp((x, y, z), found is None or found.certain)
