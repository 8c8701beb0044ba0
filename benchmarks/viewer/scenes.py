"""Generated scenes and edits for the viewer's benchmarks, so that anybody can repeat them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.demo_scenes import bear
from progdf.field.baked import AttributeBases, BakedField
from progdf.field.separable import quantize_bases
from progdf.formats.scene_file import load_scene
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf, fingerprint
from progdf.region import Region
from viewer.camera.view_camera import bounds_of

SIZES = (31_000, 125_000)
"""Numbers of Gaussians of the default bears."""

COPIES = 4
"""Number of copies of the largest scene that make up an even larger one."""

RENDERERS = {"gl": "OpenGL", "cpu": "CPU"}
"""Renderers, from `engine.DRAWS`, with their names in tables."""

RANKS = 3  # bases beside the full offset
# share of the scene's radius
_EDIT_SHIFT = 0.003
_COPY_JITTER = 0.002


def scenes_of(paths: Sequence[Path] = ()) -> list[Gaussians]:
    """Load the scenes of these .ply files, or make bears; the smallest comes first.

    Raises:
        ProgdfError: a file is missing or broken.
    """
    scenes = [load_scene(path) for path in paths] or [bear(size).gaussians for size in SIZES]
    return sorted(scenes, key=len)


def copies(scene: Gaussians, times: int = COPIES) -> Gaussians:
    """Copy the scene over itself, as dense as a scene trained with `times` as many Gaussians.

    The centers of every copy are shifted by normal noise of 0.2 % of the radius.
    """
    rng = torch.Generator().manual_seed(0)
    repeated: dict[str, Any] = {name: torch.cat([getattr(scene, name)] * times) for name in ATTRIBUTES}
    many = replace(scene, **repeated)
    off = torch.randn(many.means.shape, generator=rng)
    off[: len(scene)] = 0.0
    return replace(many, means=many.means + _COPY_JITTER * bounds_of(scene).radius * off)


def edit_for(scene: Gaussians, members: int, moves: bool) -> Gdf:
    """Make a random edit of the Gaussians nearest to the scene's center, with the size of a trained one.

    It is stored in int8, with three bases beside the full offset.

    Args:
        scene: the original
        members: number of Gaussians; all if the scene has fewer
        moves: True also moves, rotates and scales them, False only recolors them
    """
    rng = torch.Generator().manual_seed(0)
    region = _nearest(scene, members)
    distance = _EDIT_SHIFT * bounds_of(scene).radius
    spread = {"means": distance, "log_scales": 0.01, "quats": 0.01, "sh0": 0.5} if moves else {"sh0": 0.5}
    nodes = torch.linspace(0, 1, 9)
    bumps = [torch.sin(math.pi * (k + 1) * nodes) for k in range(RANKS)]
    coefficients = torch.stack([nodes, *bumps], dim=1)
    coefficients[-1] = torch.tensor([1.0] + [0.0] * RANKS)
    attributes = {}
    for name, size in spread.items():
        width = 4 if name == "quats" else 3
        end, unit = quantize_bases(size * torch.randn(1, len(region), width, generator=rng), torch.int8)
        attributes[name] = AttributeBases(
            end_offset=end[0],
            residual_basis=torch.randint(
                -127, 128, (RANKS, len(region), width), generator=rng, dtype=torch.int8
            ),
            scale=torch.cat([unit, torch.full((RANKS, width), 2e-3 * size)]),
            coefficients=coefficients.clone(),
        )
    score = torch.zeros(len(scene)).index_fill(0, region, 1.0)
    field = BakedField("separable", nodes, attributes, 14)
    return Gdf("edit", Region("edit", region, score), field, fingerprint(scene))


def _nearest(scene: Gaussians, count: int) -> Tensor:
    center = torch.tensor(bounds_of(scene).center)
    distances = (scene.means - center).norm(dim=1).nan_to_num(nan=math.inf)
    chosen: Tensor = distances.argsort(stable=True)[:count].sort().values
    return chosen
