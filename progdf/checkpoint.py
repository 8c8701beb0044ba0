"""The .gdf file: one region's edit, bound to its scene. The only contract of trainer and viewer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as default
from typing import Any

from progdf.field.baked import BakedField
from progdf.region import Region


@dataclass(frozen=True)
class SceneFingerprint:
    """What binds a .gdf to its scene: number of Gaussians and SHA-256 of the means (float32 bytes)."""

    count: int
    means_sha256: str


@dataclass(frozen=True)
class Gdf:
    """One region's edit.

    Args:
        name: the layer's name, e.g. "shirt"
        region: members and soft score
        field: the baked field of those members
        scene: the scene it was made for
        instruction: what was asked for, e.g. "recolor:#3060d0"
        options: the training options, JSON values
        report: the run's error report, JSON values (see report.json in the run folder)
    """

    name: str
    region: Region
    field: BakedField
    scene: SceneFingerprint
    instruction: str = ""
    options: Mapping[str, Any] = default(default_factory=dict)
    report: Mapping[str, Any] = default(default_factory=dict)
