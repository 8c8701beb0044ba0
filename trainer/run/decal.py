"""A run whose edit is painted: discs on the surface, written and measured; there is nothing to train."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from scipy import ndimage
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.field.separable import course_field, opacity_course
from progdf.gaussians import Gaussians, pack, unpack
from progdf.gdf.file import Gdf, fingerprint
from progdf.metrics.image import psnr
from progdf.quaternions import rotate_vectors
from progdf.region import Region
from trainer.editors.decal import DecalEditor
from trainer.paint.discs import DISC_LOGIT, Discs, Paint, faint, place_discs
from trainer.paint.solve import join, solve_colors
from trainer.views.view import BACKGROUND, make_view, render_view

RING = 15
"""Pixels around the paint that must stay as they are."""
TURNS = (-45, -30, -15, 0, 15, 30, 45)
"""Degrees about what is painted, from which it is measured."""

_FLAT = 0.03  # root mean square of color that one disc may be off, over its pixels
_LEAST_BOX = 32  # pixels around the paint whose colors are solved for


@dataclass(frozen=True)
class Painted:
    """An edit that adds discs, and how well it shows what was painted."""

    gdf: Gdf
    figures: dict[str, Any]  # for report.json
    expected: list[Tensor]  # what the views of `TURNS` shall show. [H,W,3] each
    shown: list[Tensor]  # and what they show


def paint_gdf(scene: Gaussians, paint: Paint, name: str) -> tuple[Gdf, Discs]:
    """The edit whose own view is `paint` at strength 1: opacities rise linearly, rows before it make way.

    Args:
        scene: the original
        paint: see `Paint`
        name: of the layer

    Raises:
        ProgdfError: nothing is painted on anything opaque.
    """
    discs = place_discs(scene, paint, _FLAT)
    if not len(discs.cells):
        raise ProgdfError("nothing is painted where the picture is opaque; paint on the scene")
    box = _box_of(paint.painted, paint.camera)
    ended, added = solve_colors(discs.scene, discs.moved, discs.added, paint.camera, paint.picture, box)
    before = scene[discs.moved]
    ends = pack(ended[discs.moved]) - pack(before)
    start = faint(added)
    knots, rise = opacity_course(start.logit_opacities, torch.full((len(added),), DISC_LOGIT))
    offsets = torch.zeros(len(knots), len(before) + len(added), ends.shape[1])
    offsets[:, : len(before)] = knots[:, None, None] * ends
    offsets[:, len(before) :, _LOGIT] = rise
    score = torch.zeros(len(scene)).index_fill(0, discs.moved, 1.0)
    region = Region(name, discs.moved, score)
    return Gdf(name, region, course_field(knots, offsets), fingerprint(scene), added=start), discs


_LOGIT = 10
"""Channel of the opacity in a packed row, see `attribute_slices`."""


def _box_of(painted: Tensor, camera: Camera) -> tuple[int, int, int, int]:
    """The window around the paint in which moved rows may show: half as large again on each side."""
    rows, columns = painted.nonzero().T
    (top, bottom), (left, right) = ((int(axis.min()), int(axis.max()) + 1) for axis in (rows, columns))
    margin = _LEAST_BOX + max(bottom - top, right - left) // 2
    return (
        max(0, left - margin),
        max(0, top - margin),
        min(camera.width, right + margin),
        min(camera.height, bottom + margin),
    )


def train_decal(editor: DecalEditor, scene: Gaussians, name: str) -> Painted:
    """The edit of a decal, measured in its own view and around it.

    Args:
        editor: see `DecalEditor`
        scene: the original
        name: of the layer
    """
    paint = editor.paint
    gdf, discs = paint_gdf(scene, paint, name)
    edited, background = finished_scene(scene, gdf), torch.tensor(BACKGROUND)
    expected, shown, turned = list[Tensor](), list[Tensor](), dict[str, float | None]()
    pivot = _middle(discs)
    for degrees in TURNS:
        view = editor.view
        if degrees:
            view = make_view(scene, gdf.region, orbit(paint.camera, pivot, degrees), background)
        expected.append(editor.edit(view, 1.0))
        shown.append(render_view(edited, view.camera, background).clamp(0.0, 1.0))
        covered = (expected[-1] != view.image).any(dim=2)
        error = psnr(shown[-1], expected[-1], covered) if bool(covered.any()) else None
        turned[f"{degrees:+d}"] = None if error is None else round(error, 2)
    middle = TURNS.index(0)
    grown = torch.from_numpy(ndimage.binary_dilation(paint.painted.numpy(), iterations=RING))
    figures = {
        "pixels": int(paint.painted.sum()),
        "added": len(discs.added),
        "moved": len(discs.moved),
        "own": round(psnr(shown[middle], paint.picture, paint.painted), 2),
        "ring": round(psnr(shown[middle], paint.picture, grown & ~paint.painted), 2),
        "turned": turned,
    }
    return Painted(gdf, figures, expected, shown)


def finished_scene(scene: Gaussians, gdf: Gdf) -> Gaussians:
    """The scene as the edit's field has it at strength 1, the added rows after its own."""
    if gdf.added is None:
        raise ValueError(f"{gdf.name} adds nothing")
    end, members = gdf.field.offsets(1.0), gdf.region.members
    moved = scene.replace_rows(members, pack(scene[members]) + end[: len(members)])
    return join(moved, unpack(pack(gdf.added) + end[len(members) :], gdf.added.shN))


def _middle(discs: Discs) -> Tensor:
    """The added row that lies nearest to the median of all. [3]"""
    means = discs.added.means
    return means[int((means - means.median(dim=0).values).norm(dim=1).argmin())]


def orbit(camera: Camera, pivot: Tensor, degrees: float) -> Camera:
    """The camera turned about an axis through a point that is upright in its picture."""
    c2w = camera.c2w.double()
    axis, half = c2w[:3, 1], 0.5 * math.radians(degrees)
    turn = torch.cat([torch.tensor([math.cos(half)]).double(), math.sin(half) * axis])
    turned = torch.eye(4, dtype=torch.float64)
    turned[:3, :3] = rotate_vectors(c2w[:3, :3].T, turn[None]).T
    turned[:3, 3] = pivot.double() + rotate_vectors(c2w[:3, 3] - pivot.double(), turn)
    return replace(camera, viewmat=torch.linalg.inv(turned).float(), name=f"decal{degrees:+.0f}")
