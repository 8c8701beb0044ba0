"""Facts about the open scene's edits: their rows in the panel."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.added import rows_on
from progdf.compose.layers import KINDS
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.texture import has_texture
from progdf.rasterize import render
from progdf.sh import sh0_to_rgb
from progdf.system.equality import equal_fields
from progdf.terminal import format_count, group_digits
from viewer.camera.view_camera import Bounds, Fit, ViewCamera, bounds_of, fit, keep_camera, to_camera

Rgb = tuple[float, float, float]

THUMBNAIL_SIDE = 48
"""Width and height of a layer's thumbnail, px."""
MAX_COUNTED_MEMBERS = 20_000
"""Largest number of Gaussians in a thumbnail.

Larger regions are subsampled at a constant stride, so that drawing takes a fraction of a second.
"""

_EMPTY_CONTRAST = 0.05  # a thumbnail with less contrast shows nothing, 0 to 1
_THUMBNAIL_GRAY = 56  # background of a thumbnail, 0 to 255
_THUMBNAIL_DISTANCE = 0.7  # camera distance as a share of the framing distance


FILL_BASE_S = 8.0
"""Estimate of the seconds to fill a hole in a small scene, for two processor cores."""
FILL_S_PER_MILLION = 100.0
"""Estimate of the further seconds per million Gaussians of the scene."""

Hole = Literal["", "open", "filled"]
"""State of the hole that a removal leaves; "" for other edits."""

Thumbnail = Callable[[ViewCamera], NDArray[np.uint8]]


def _no_rows(_: NDArray[np.bool_]) -> NDArray[np.int64]:
    return np.zeros(0, np.int64)


@dataclass(frozen=True)
class LayerRow:
    """Facts about one .gdf that the panel shows."""

    __eq__ = equal_fields

    count: int  # Gaussians in its region
    swatch: Rgb  # their mean color at full strength, 0 to 1
    recorded: tuple[float, ...]  # strengths of the recorded snapshots
    instruction: str  # the instruction it was trained with
    bounds: Bounds  # bounds of the bulk of its members
    # number of Gaussians shared with each edit, in the order of the edits (with itself: all)
    shared: tuple[int, ...] = ()
    kinds: frozenset[str] = frozenset(
        (*KINDS.values(), "texture")
    )  # the gains of `Gains` that have an effect
    # centers of its members in the original, world units. [M,3] float32
    points: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32), compare=False)
    fit: Fit = keep_camera  # returns the camera that frames its members
    region: str = ""  # name of its region
    region_spec: str = ""  # the region option of its training, "" if unknown
    # rows of its members in the drawn scene. [M] int64
    members: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64), compare=False)
    draft: bool = False  # a preliminary grade until training ends
    added: int = 0  # number of members that are not in the original scene
    sources: str = ""  # its part from a picture and its part that is a guess, one line; "" without pictures
    hole: Hole = ""
    fill_seconds: float = 0.0  # estimated seconds to fill the hole
    from_others: int = 0  # number of its last members that other edits add
    # returns the rows that it adds on some rows of the drawn scene, see `rows_on`. [N] bool -> [A] int64
    rows_on: Callable[[NDArray[np.bool_]], NDArray[np.int64]] = field(default=_no_rows, compare=False)
    # renders its thumbnail, see `draw_thumbnail`
    thumbnail: Thumbnail = field(default=lambda _: np.zeros((48, 48, 3), np.uint8), compare=False)


def layer_rows(scene: Gaussians, gdfs: Sequence[Gdf], added: Sequence[int] = ()) -> tuple[LayerRow, ...]:
    """Return one row per .gdf, in order.

    Args:
        scene: the scene with all added Gaussians
        gdfs: the edits
        added: number of Gaussians that each edit adds, see `extend`; empty means none
    """
    return tuple(
        _row(scene, gdf, gdfs, count) for gdf, count in zip(gdfs, added or [0] * len(gdfs), strict=True)
    )


def _row(scene: Gaussians, gdf: Gdf, gdfs: Sequence[Gdf], added: int) -> LayerRow:
    members = gdf.region.members
    region_options = gdf.options.get("region")
    return LayerRow(
        count=len(members),
        swatch=_mean_color(scene, gdf),
        recorded=gdf.field.recorded,
        instruction=gdf.instruction,
        bounds=bounds_of(scene[members]),
        shared=tuple(_shared_count(gdf, other) for other in gdfs),
        kinds=_kinds(gdf),
        points=scene.means[members].numpy(),
        fit=lambda camera, aspect: fit(camera, scene[members], aspect),
        region=gdf.region.name,
        region_spec=str(region_options.get("region", "")) if isinstance(region_options, dict) else "",
        members=members.numpy(),
        draft="draft" in gdf.report,
        added=added,
        sources=_sources(gdf),
        hole=_hole(gdf),
        fill_seconds=FILL_BASE_S + FILL_S_PER_MILLION * len(scene) / 1e6,
        from_others=gdf.from_others,
        rows_on=lambda mask: rows_on(gdf, torch.tensor(mask)).numpy(),
        thumbnail=partial(draw_thumbnail, scene, gdf),
    )


def _kinds(gdf: Gdf) -> frozenset[str]:
    """Return the gains that have an effect on an edit."""
    kinds = {KINDS[name] for name in gdf.field.attributes}
    if gdf.paints:
        kinds.add("color")
    if has_texture(gdf):
        kinds.add("texture")
    return frozenset(kinds)


def _hole(gdf: Gdf) -> Hole:
    """Return the state of a removal's hole; "" for other edits."""
    if gdf.instruction != "remove" or not len(gdf.region):
        return ""
    if "removal" in gdf.report:  # made by `progdf train`, which fills holes
        return "filled"
    return "" if gdf.added is not None else "open"


def _sources(gdf: Gdf) -> str:
    """Return `LayerRow.sources` of an edit from pictures, see report.json."""
    found = gdf.report.get("carry_on")
    if not isinstance(found, Mapping):
        return ""
    shown, guessed, unchanged = (
        group_digits(count) if isinstance(count := found.get(name), int) and count else ""
        for name in ("from_pictures", "guessed", "unchanged")
    )
    parts = [f"{shown or 0} splats from the picture"]
    parts += [f"{guessed} guessed by its color map"] if guessed else []
    parts += [f"{unchanged} not in it and unchanged"] if unchanged else []
    return ", ".join(parts)


def _shared_count(gdf: Gdf, other: Gdf) -> int:
    """Return the number of Gaussians that two regions share."""
    members = (gdf.region.members.numpy(), other.region.members.numpy())
    return len(np.intersect1d(*members, assume_unique=True))


def _mean_color(scene: Gaussians, gdf: Gdf) -> Rgb:
    """Return the mean of the edited colors, weighted by the original opacities."""
    members = gdf.region.members
    if not len(members):
        return 0.5, 0.5, 0.5
    sh0 = scene.sh0[members]
    bases = gdf.field.attributes.get("sh0")
    if bases is not None:
        sh0 = sh0 + bases.end
    weights = scene.opacities[members].nan_to_num()[:, None] + 1e-6
    color = (sh0_to_rgb(sh0).nan_to_num().clamp(0.0, 1.0) * weights).sum(0) / weights.sum()
    red, green, blue = (float(c) for c in color)
    return red, green, blue


def _edited_region(scene: Gaussians, gdf: Gdf, strength: float = 1.0) -> Gaussians:
    """Return the region at a strength, subsampled to at most `MAX_COUNTED_MEMBERS` Gaussians."""
    stride = max(-(-len(gdf.region.members) // MAX_COUNTED_MEMBERS), 1)
    region = scene[gdf.region.members[::stride]]
    edited = dict[str, Any]()
    for name in gdf.field.attributes:
        old: Tensor = getattr(region, name)
        edited[name] = old + gdf.field.attribute_offsets(name, strength)[::stride].reshape(old.shape)
    return replace(region, **edited)


def draw_thumbnail(scene: Gaussians, gdf: Gdf, camera: ViewCamera) -> NDArray[np.uint8]:
    """Render the region alone at full strength, framed from the direction of `camera`.

    Returns:
        [THUMBNAIL_SIDE,THUMBNAIL_SIDE,3] uint8
    """
    side = THUMBNAIL_SIDE
    region = _edited_region(scene, gdf)
    if not len(region):
        return np.full((side, side, 3), _THUMBNAIL_GRAY, np.uint8)
    with torch.no_grad():
        framed = fit(camera, region, 1.0)
        thumbnail_camera = to_camera(
            replace(framed, distance=_THUMBNAIL_DISTANCE * framed.distance), side, side
        )
        background = (_THUMBNAIL_GRAY / 255,) * 3
        image = render(region, thumbnail_camera, background).image
        if float((image.nan_to_num() - background[0]).abs().max()) < _EMPTY_CONTRAST:
            image = _struck_out(render(_edited_region(scene, gdf, 0.0), thumbnail_camera, background).image)
    pixels: NDArray[np.uint8] = (image.nan_to_num().clamp(0.0, 1.0) * 255).round().byte().numpy()
    return pixels


def _struck_out(image: Tensor) -> Tensor:
    """Return the thumbnail of a removed region: half of its color, under a diagonal line. [H,W,3]"""
    faded = torch.lerp(image, torch.full_like(image, _THUMBNAIL_GRAY / 255), 0.5)
    rows = torch.arange(len(image))
    for shift in (-1, 0, 1):
        faded[rows, (len(image) - 1 - rows + shift).clamp(0, len(image) - 1)] = 0.9
    return faded


def describe_loaded(gdf: Gdf) -> str:
    """Return one line on a loaded edit that differs from its file, or "" if it does not.

    A grade applied to another region omits parts. Added rows of an older file get anchors.
    """
    added = gdf.members - len(gdf.region)
    if gdf.anchors_found and added:
        rows = format_count(added, "added Gaussian")
        return f"{gdf.name}: its file has no anchors, so its {rows} follow the nearest surface"
    parts = gdf.report.get("left_out") if gdf.applied else ""
    left_out = f"without its {parts}, which fits only the scene it was trained on"
    return f"{gdf.name} on {gdf.region.name}: {left_out}" if parts else ""
