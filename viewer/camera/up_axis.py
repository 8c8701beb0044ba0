"""Which way is up in the window and in pictures: said, kept with an edit, or found in the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.scene.up_axis import find_up, up_from_json

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class SceneUp:
    """The world direction that is up, unit length, whether that is certain, and what else it may be."""

    direction: Vec3
    certain: bool
    candidates: tuple[Vec3, ...] = ()  # the likeliest first
    reason: str = ""  # for a person; "" of an edit that knew


def up_of(
    scene: Gaussians,
    gdfs: Sequence[Gdf] = (),
    asked: str = "auto",
    cameras: Sequence[Camera] = (),
) -> Vec3:
    """The direction of `find_scene_up`."""
    return find_scene_up(scene, gdfs, asked, cameras).direction


def find_scene_up(
    scene: Gaussians,
    gdfs: Sequence[Gdf] = (),
    asked: str = "auto",
    cameras: Sequence[Camera] = (),
    path: Path | None = None,
) -> SceneUp:
    """Which way is up.

    Args:
        scene: the original
        gdfs: its edits, whose training may have known
        asked: an axis, or "auto"
        cameras: given with the scene
        path: its file
    """
    kept = (up_from_json(gdf.report.get("up")) for gdf in gdfs) if asked == "auto" else ()
    known = next((up for up in kept if up is not None), None)
    found = find_up(scene, cameras, asked, path) if known is None and len(scene) else None
    if found is not None:
        known = found.direction
    x, y, z = (0.0, 1.0, 0.0) if known is None else (float(c) for c in known)
    said = "" if found is None else f"{found.name}, {found.reason}"
    others = () if found is None else tuple((a, b, c) for a, b, c in (up.tolist() for up in found.candidates))
    return SceneUp((x, y, z), found is None or found.certain, others, said)
