"""Layers below a new edit that is made from pictures of an edited scene.

A picture may show other layers, at the strengths in its metadata. The new edit is the difference between the
picture and the view as shown. So it is trained on the scene under these layers:

- `seen` is the scene as the picture shows it.
- `base` is the scene that the new edit changes: the rows of the original under the layers that add no paint.
  Discs of lower layers are not part of it, because the new edit cannot change their rows.

The trained edit changes `base`. `rebase` converts it to an edit of the original that gives the same result
above the lower layers at the strengths of the picture.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.compose.follow import carry_rows, pack_shapes, unpack_shapes
from progdf.compose.picture_layers import OpenLayer, compose_picture, find_layer_files, open_picture_layers
from progdf.compose.reference import color_coverage
from progdf.errors import ProgdfError
from progdf.field.separable import course_field
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from progdf.gdf.file import Gdf, fingerprint
from progdf.io.picture_camera import PictureLayers, layers_in_picture

_FIRST_COLOR_COLUMN = 11  # of a packed row; see `attribute_slices`
_SHAPE_COLUMNS = slice(0, _FIRST_COLOR_COLUMN)  # of a packed row, in the order of `pack_shapes`
_OPACITY_COLUMN = 10  # of a packed row
_BISECTIONS = 12  # steps of the search for the coverage
_DAMPED_STEPS = 12  # further steps, as the coverage of a member also depends on the other members
_COLOR_STEPS = 8  # maximum number of steps for the colors of added rows
_COLOR_TOLERANCE = 0.005  # SH coefficient; smaller errors are not visible
_FOLLOW_KNOTS = 9  # knots of an edit whose rows lie on a moved surface


@dataclass(frozen=True)
class LowerLayers:
    """Layers that the changed pictures show, and the scene under them."""

    layers: PictureLayers
    original: Gaussians  # N Gaussians
    stack: Sequence[OpenLayer]  # the lowest first
    seen: Gaussians  # the scene as the pictures show it; N rows and those that the layers add
    base: Gaussians  # the scene that the new edit changes. N Gaussians

    @property
    def paints(self) -> bool:
        """True if the pictures show rows that are no part of `base`."""
        return len(self.seen) > len(self.base)

    def compose(self, gdf: Gdf) -> Gaussians:
        """Return the scene under the layers and an edit of the original on top of them."""
        return compose_picture(self.original, self.stack, self.layers.blend, gdf)

    def rebase(self, gdf: Gdf) -> Gdf:
        """Return an edit of the base as an edit of the original.

        Colors: with the blend rules that hide lower layers by the coverage c, the sum of the lower changes B
        becomes (1 − c) B. The edit adds s c B, so that B stays whole at every strength s. Geometry and
        opacity are moved back along the lower layers, which carry them forward again. Every rule keeps B
        whole under colors that only make way for discs, see `Anchors.pushes`.

        Args:
            gdf: edit of `base`
        """
        members = gdf.region.members
        bands = gdf.field.channels > BASE_CHANNELS
        before = pack(self.original[members], with_shN=bands)
        below = pack(self.base[members], with_shN=bands)
        edit = replace(gdf, scene=fingerprint(self.original))
        if torch.equal(before, below) and gdf.added is None:
            return edit
        knots = gdf.field.knots
        if bool((before[:, _SHAPE_COLUMNS] != below[:, _SHAPE_COLUMNS]).any()):
            knots = torch.unique(torch.cat([knots, torch.linspace(0.0, 1.0, _FOLLOW_KNOTS)]))
        offsets = torch.stack([gdf.field.offsets(s) for s in knots.tolist()])
        count = len(members)
        offsets[:, :count, _SHAPE_COLUMNS] = _pushes_on_original(offsets[:, :count], before, below)
        edit = self._move_added(edit)
        lower = (below - before)[:, _FIRST_COLOR_COLUMN:]
        blends = gdf.anchors is None or "color" not in gdf.anchors.pushes
        if blends and self.layers.blend != "sum" and bool(lower.any()):
            change = offsets[-1, :, _FIRST_COLOR_COLUMN:]
            share = _hidden_share(change.reshape(len(change), -1, 3), lower.reshape(count, -1, 3))
            kept = share[:, None] * lower
            offsets[:, :count, _FIRST_COLOR_COLUMN:] += knots[:, None, None] * kept
        field = replace(course_field(knots, offsets), recorded=gdf.field.recorded)
        return self._keep_added_colors(replace(edit, field=field))

    def _move_added(self, gdf: Gdf) -> Gdf:
        """Return the edit with its added rows moved from the surface of `base` to that of the original."""
        added = gdf.added
        anchors = gdf.anchors
        if added is None or anchors is None:
            return gdf
        shapes = pack_shapes(added)
        follows = anchors.weights.sum(dim=1) > 0.0
        at = anchors.rows[follows]
        old = pack_shapes(self.base)[at]
        new = pack_shapes(self.original)[at]
        moved = carry_rows(shapes[follows], old, new, anchors.weights[follows].double())
        shapes[follows, :_OPACITY_COLUMN] = moved[:, :_OPACITY_COLUMN]
        return replace(gdf, added=_with_shapes(added, shapes))

    def _keep_added_colors(self, gdf: Gdf) -> Gdf:
        """Return the edit with added rows that have their colors above the layers.

        A grade of the whole scene also changes added rows, those of the edit above it included. Their own
        colors are found by fixed-point steps.
        """
        added = gdf.added
        if added is None or not len(added):
            return gdf
        expected = added.sh0
        best = gdf
        least = math.inf
        for _ in range(_COLOR_STEPS):
            edit = replace(gdf, added=added)
            error = expected - self.compose(edit).sh0[-len(added) :]
            largest = float(error.abs().max())
            if largest >= least:
                break
            best = edit
            least = largest
            if largest < _COLOR_TOLERANCE:
                break
            added = replace(added, sh0=added.sh0 + error)
        return best


def _with_shapes(gaussians: Gaussians, shapes: Tensor) -> Gaussians:
    """Return Gaussians with other geometry and opacity, see `pack_shapes`. [N,11]"""
    parts: dict[str, Any] = {name: part.contiguous() for name, part in unpack_shapes(shapes).items()}
    return replace(gaussians, **parts)


def _hidden_share(change: Tensor, lower: Tensor) -> Tensor:
    """Return the share of the lower colors that an edit hides once it adds that share to its change. [M]

    The coverage of a member grows with its change, so the balance is found by bisection.

    Args:
        change: SH change of the edit, of its members and added rows. [M+B,K,3]
        lower: SH change by the lower layers, of its members. [M,K,3]
    """
    count = len(lower)
    share = torch.zeros(count)
    low = torch.zeros(count)
    high = torch.ones(count)
    for _ in range(_BISECTIONS):
        share = 0.5 * (low + high)
        total = change.clone()
        total[:count] += share[:, None, None] * lower
        is_above = color_coverage(total)[:count] > share
        low = torch.where(is_above, share, low)
        high = torch.where(is_above, high, share)
    for _ in range(_DAMPED_STEPS):
        total = change.clone()
        total[:count] += share[:, None, None] * lower
        share = 0.5 * (share + color_coverage(total)[:count])
    return share


def _pushes_on_original(offsets: Tensor, before: Tensor, below: Tensor) -> Tensor:
    """Return the shape offsets of members, moved back along the lower layers. [S,M,11]

    Args:
        offsets: offsets from the base. [S,M,C]
        before, below: the members in the original and in the base. [M,C]
    """
    old = below[:, None, _SHAPE_COLUMNS].expand(-1, 4, -1)
    new = before[:, None, _SHAPE_COLUMNS].expand(-1, 4, -1)
    weights = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(len(before), 4)
    moved = []
    for state in offsets:
        change = state[:, _SHAPE_COLUMNS]
        carried = carry_rows(below[:, _SHAPE_COLUMNS] + change, old, new, weights)
        is_moved = (change != 0).any(dim=1, keepdim=True) & (old[:, 0] != new[:, 0]).any(dim=1, keepdim=True)
        moved.append(torch.where(is_moved, carried - before[:, _SHAPE_COLUMNS], change))
    return torch.stack(moved)


def check_lower_layers(pictures: Sequence[Path], scene: Path | None) -> PictureLayers | None:
    """Return the layers that changed pictures show; None for pictures of the original.

    Args:
        pictures: the changed pictures
        scene: file of the scene; None: unknown

    Raises:
        ProgdfError: the layers of a picture are damaged, unknown or missing, or the pictures show different
            layers or strengths.
    """
    shown = {path: layers_in_picture(path) for path in pictures}
    first = next(iter(shown), None)
    for path, layers in shown.items():
        if layers != shown[pictures[0]]:
            raise ProgdfError(
                f"{path} shows {layers or 'no edits'}, {first} shows {shown[pictures[0]] or 'no edits'}; "
                "take all views with the same layers at the same strengths"
            )
        if layers is not None:
            find_layer_files(layers, path, scene)
    return None if first is None else shown[first]


def open_lower_layers(
    pictures: Sequence[Path], scene_path: Path | None, scene: Gaussians
) -> LowerLayers | None:
    """Return the layers that changed pictures show, with the scene under them; None for the original.

    Args:
        pictures: the changed pictures
        scene_path: file of the scene; None: unknown
        scene: the original

    Raises:
        ProgdfError: see `check_lower_layers` and `load_gdf`.
    """
    layers = check_lower_layers(pictures, scene_path)
    if layers is None:
        return None
    files = find_layer_files(layers, pictures[0], scene_path)
    name = "the scene" if scene_path is None else scene_path.name
    stack = open_picture_layers(layers, files, scene, name)
    seen = compose_picture(scene, stack, layers.blend)
    unpainted = [layer for layer in stack if layer.gdf.anchors is None or not layer.gdf.anchors.pushes]
    base = seen
    if len(unpainted) < len(stack):
        base = compose_picture(scene, unpainted, layers.blend)
    return LowerLayers(layers, scene, stack, seen, base[: len(scene)])
