"""Container of a web page: a scene and its edits as the arrays that the page's script reads.

The page reads a container (src/data.js): the length of its header, the header (JSON), and its arrays. An
array is stored channel by channel, split into planes of equal-weight bytes, which gzip compresses better.
Members of edits come first. Members of the same edits are adjacent, so that a slider uploads few runs of
rows, and neighbors in space are close together.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.follow import (
    COLORS,
    FOLLOWED,
    Followers,
    banded_followers,
    find_followers,
    find_rims,
    state_scene,
)
from progdf.compose.layers import KINDS
from progdf.compose.overlap import ARRANGED, find_paint
from progdf.compose.parents.rows import MOVED, still
from progdf.compose.reference import coverage
from progdf.errors import ProgdfError
from progdf.field.baked import AttributeBases, BakedField, GradeForm
from progdf.field.grade import sphere
from progdf.field.separable import quantize_bases
from progdf.formats.packed.compressed_ply import morton_order
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import UNSEEN_LOGIT, Gdf
from progdf.gdf.texture import ColorSplit, color_split

from .moves import pack_moves

DRAWN_SH = (0, 3, 8, 15)
"""Number of SH coefficients above the first, by degree."""
LEVELS = {"i1": 127, "i2": 32767}
"""Largest quantization level by type of array."""
_MAX_SEGMENT = 1 << 12  # members composed at once, which limits memory
_MIN_AXIS_SHARE = 1e-4  # share of the scene's spread: a smaller axis is below a pixel in any picture
_UNSEEN_LOGIT = -1e3  # logit of a Gaussian that is not drawn
_MAX_OPACITY = 1 - 1 / 512  # 8-bit opacities are clipped to 1 − _MAX_OPACITY … _MAX_OPACITY


@dataclass
class Arrays:
    """Arrays of a container, in the order in which they were added."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0

    def add(self, values: NDArray[Any], **more: Any) -> dict[str, Any]:
        """Append an array [n] or [n,c]; return its header entry."""
        table = np.ascontiguousarray(_table(values).T)
        table = table.astype(table.dtype.newbyteorder("<"))
        planes = table.reshape(-1, 1).view(np.uint8).T.tobytes()
        kind = f"{table.dtype.kind}{table.dtype.itemsize}"
        record = {"at": self.size, "type": kind, "rows": len(values), "width": len(table), **more}
        self.parts.append(planes)
        self.size += len(planes)
        return record

    def add_levels(
        self, values: NDArray[Any], kind: str, curve: str = ""
    ) -> tuple[dict[str, Any], NDArray[Any]]:
        """Append numbers quantized between the minimum and maximum of each channel. [n,c] float

        Args:
            kind: key of `LEVELS`
            curve: "log" for signed logarithms (1 + |x|), "logit" for opacities

        Returns:
            Its header entry, and the values that the page decodes.
        """
        table = _table(values).astype(np.float64)
        if curve == "log":
            table = np.sign(table) * np.log1p(np.abs(table))
        some = table if len(table) else np.zeros((1, table.shape[1]))
        low = some.min(axis=0)
        high = some.max(axis=0)
        zero = (low + high) / 2
        max_level = LEVELS[kind]
        step = np.where(high > low, (high - low) / (2 * max_level), 1.0)
        levels = np.round((table - zero) / step).astype(f"<{kind}")
        decoded = zero + step * levels
        if curve == "log":
            decoded = np.sign(decoded) * np.expm1(np.abs(decoded))
        elif curve == "logit":
            decoded = np.log(decoded / (1 - decoded))
        return self.add(levels, scale=step.tolist(), zero=zero.tolist(), curve=curve), decoded


def _table(values: NDArray[Any]) -> NDArray[Any]:
    """Reshape [n] or [n,…] to [n,c]."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


@dataclass(frozen=True)
class Packed:
    """Content of a page."""

    data: bytes  # the container
    scene: Gaussians  # the original as decoded by the page, in the scene's order; omitted rows are invisible


def pack(
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    quality: str,
    degree: int,
    more: Mapping[str, Any],
) -> Packed:
    """Return the container of a scene and its edits. The scene already has the rows that the edits add.

    Args:
        scene: the original with the rows that edits add
        gdfs: its edits
        quality: "exact", float32 and the numbers of the edits' files, or "compact", 8 and 16 bits
        degree: retained degree of the spherical harmonics, 0 to 3
        more: other header entries; "paints" holds pairs of an edit and the weights of its members [M], and
            "split" the edits of layers whose gains divide color and texture

    Raises:
        ProgdfError: there is no such quality.
    """
    if quality not in ("exact", "compact"):
        raise ProgdfError(f"unknown quality '{quality}'; use exact or compact")
    scene, kept = _finite(scene), min(DRAWN_SH[degree], scene.shN.shape[1])
    groups = _groups(len(scene), [gdf.region.members.numpy() for gdf in gdfs])
    seen = (groups > 0) | (scene.logit_opacities.numpy() >= UNSEEN_LOGIT)
    moving = gdfs
    gdfs = [still(gdf) for gdf in gdfs]
    order = _order(scene, groups)
    order = order[seen[order]]
    count = int((groups[order] > 0).sum())
    place = np.full(len(scene), -1, np.int64)
    place[order] = np.arange(len(order))
    inside = [_ascending(place[gdf.region.members.numpy()]) for gdf in gdfs]
    arrays = Arrays()
    exact = quality == "exact"
    attributes, decoded_scene = _scene(arrays, scene, moving, order, count, kept, exact)
    overlaps = len(gdfs) > 1 and sum(map(len, inside)) > count
    splits = {edit: color_split(scene, gdfs[edit]) for edit in more["split"]}
    paints = []
    for edit, weights in more["paints"]:
        levels = np.round(weights[inside[edit]].numpy() * 255).astype("<i2")
        paints.append(arrays.add(levels, scale=[1 / 255], zero=[0.0]))
    header = {
        **more,
        "paints": paints,
        "split": sorted(splits),
        "count": len(order),
        "members": count,
        "segments": _segments(groups[order[:count]], order, gdfs),
        "sh": kept,
        "antialiased": scene.antialiased,
        "attributes": attributes,
        "edits": [
            _edit(
                arrays,
                gdf,
                rows,
                kept,
                exact,
                shares=coverage(scene, gdf) if overlaps else None,
                split=splits.get(edit),
            )
            for edit, (gdf, rows) in enumerate(zip(gdfs, inside, strict=True))
        ],
        "surface": _surface(arrays, scene, gdfs, place, inside, exact),
        "paint": _paint(arrays, scene, gdfs, place, inside, kept=kept, exact=exact, splits=splits),
        "moves": pack_moves(
            moving,
            place,
            inside,
            kept,
            arrays.add,
            lambda gdf, rows: _edit(arrays, gdf, rows, kept, exact, shares=None, split=None),
        ),
        "sphere": _sphere(kept),
    }
    text = json.dumps(header, ensure_ascii=True, allow_nan=False, separators=(",", ":")).encode()
    return Packed(len(text).to_bytes(4, "little") + text + b"".join(arrays.parts), decoded_scene)


def _scene(
    arrays: Arrays,
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    order: NDArray[np.int64],
    count: int,
    kept: int,
    exact: bool,
) -> tuple[dict[str, Any], Gaussians]:
    """Append the attributes, the first `count` rows separately; return their entries and the decoded
    scene."""
    moved = {name for gdf in gdfs for name in gdf.field.attributes}
    if any(gdf.motions is not None for gdf in gdfs):
        moved.update(MOVED)
    if any(gdf.anchors is not None for gdf in gdfs):
        moved.update(FOLLOWED)
        moved.update(ARRANGED)
    attributes: dict[str, Any] = {}
    changed: dict[str, Any] = {"shN": torch.zeros_like(scene.shN)}
    changed["logit_opacities"] = torch.full_like(scene.logit_opacities, _UNSEEN_LOGIT)
    rows = torch.from_numpy(order)
    for name in ATTRIBUTES:
        old = getattr(scene, name).detach().float()
        values = _table((old[:, :kept] if name == "shN" else old)[rows].numpy())
        if not values.shape[1]:
            continue
        parts = values[:count], values[count:]
        done = [
            _scene_part(arrays, name, part, exact, first and name in moved)
            for part, first in zip(parts, (True, False), strict=True)
        ]
        attributes[name] = [record for record, _ in done]
        new = torch.from_numpy(np.concatenate([numbers for _, numbers in done])).float()
        table = changed.setdefault(name, old.clone())
        if name == "shN":
            table[rows, :kept] = new.reshape(len(order), kept, 3)
        else:
            table[rows] = new.reshape(len(order), *old.shape[1:])
    return attributes, replace(scene, **changed)


def _surface(
    arrays: Arrays,
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    place: NDArray[np.int64],
    inside: Sequence[Tensor],
    exact: bool,
) -> dict[str, Any] | None:
    """Append the rows that follow others, and the states of those; return their header entry.

    The states (see `progdf.compose.follow`) are stored like a scene of their own, with restricted edits.

    Args:
        arrays: the container's arrays
        scene: the extended scene
        gdfs: its edits
        place: position of each row on the page. [N]
        inside: members of each edit in the page's order. [M] each
        exact: store float32
    """
    followers = find_followers(gdfs, len(scene))
    if followers is None:
        return None
    states = _states(
        arrays,
        scene,
        gdfs,
        place,
        inside,
        followers=followers,
        names=FOLLOWED,
        kept=0,
        exact=exact,
        splits={},
    )
    return {**states, "banded": len(banded_followers(scene, gdfs, followers)) > 0}


def _paint(
    arrays: Arrays,
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    place: NDArray[np.int64],
    inside: Sequence[Tensor],
    kept: int,
    exact: bool,
    splits: Mapping[int, ColorSplit | None],
) -> dict[str, Any] | None:
    """Append the data for the order of painted layers, see `progdf.compose.overlap`; return its header entry.

    Args:
        arrays: the container's arrays
        scene: the extended scene
        gdfs: its edits
        place: position of each row on the page. [N]
        inside: members of each edit in the page's order. [M] each
        kept: number of SH coefficients above the first
        exact: store float32
        splits: color and texture of edits
    """
    paint = find_paint(scene, gdfs)
    if paint is None:
        return None
    members = np.empty(len(paint), np.int32)
    for edit in np.unique(paint.edits).tolist():
        page = np.empty(len(inside[edit]), np.int32)
        page[inside[edit].numpy()] = np.arange(len(page))
        mine = paint.edits == edit
        members[mine] = page[paint.members[mine]]
    pairs = []
    for (upper, lower), pair in paint.pairs.items():
        parts = {name: arrays.add(_small(values)) for name, values in vars(pair).items()}
        pairs.append({"upper": upper, "lower": lower, **parts})
    found = find_rims(gdfs, len(scene), paint)
    tints = None
    if found is not None:
        tints = _states(
            arrays,
            scene,
            gdfs,
            place,
            inside,
            followers=found,
            names=COLORS,
            kept=kept,
            exact=exact,
            splits=splits,
        )
    return {
        "rows": arrays.add(place[paint.rows].astype(np.int32)),
        "edits": arrays.add(paint.edits.astype(np.int32)),
        "members": arrays.add(members),
        "rim": arrays.add(_small(paint.rim)),
        "outward": arrays.add(_small(paint.outward)),
        "pairs": pairs,
        "tints": tints,
    }


def _small(values: NDArray[Any]) -> NDArray[Any]:
    """Return numbers in 32 bits."""
    return values.astype(np.int32 if values.dtype == np.int64 else np.float32)


def _states(
    arrays: Arrays,
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    place: NDArray[np.int64],
    inside: Sequence[Tensor],
    followers: Followers,
    names: Sequence[str],
    kept: int,
    exact: bool,
    splits: Mapping[int, ColorSplit | None],
) -> dict[str, Any]:
    """Append states and the rows that need them, see `Followers`; return their header entry.

    Args:
        arrays: the container's arrays
        scene: the extended scene
        gdfs: its edits
        place: position of each row on the page. [N]
        inside: members of each edit in the page's order. [M] each
        followers: the rows
        names: attributes of the states
        kept: number of SH coefficients above the first
        exact: store float32
        splits: color and texture of edits
    """
    states, parts = state_scene(scene, gdfs, followers, names)
    groups = _groups(len(states), [part.region.members.numpy() for part in parts])
    order = np.argsort(-groups, kind="stable")
    at = np.empty(len(order), np.int64)
    at[order] = np.arange(len(order))
    attributes = {}
    for name in names:
        old = getattr(states, name).detach().float()
        values = _table((old[:, :kept] if name == "shN" else old)[torch.from_numpy(order)].numpy())
        if not values.shape[1]:
            continue
        attributes[name] = [_scene_part(arrays, name, values, exact, True)[0]]
    edits = []
    picks = []
    for edit, (_, index) in enumerate(followers.changed):
        gdf, part, members = gdfs[edit], parts[edit], inside[edit]
        split = splits.get(edit)
        rows = _ascending(at[part.region.members.numpy()])
        covered = {kind: share[torch.from_numpy(index)] for kind, share in coverage(scene, gdf).items()}
        kinds = {"map", *(KINDS[name] for name in names)}
        shares = {kind: share for kind, share in covered.items() if kind in kinds}
        of_states = None if split is None else split.take(torch.from_numpy(index))
        edits.append(_edit(arrays, part, rows, kept, exact, shares, of_states))
        page = np.empty(len(members), np.int64)
        page[members.numpy()] = np.arange(len(members))
        picks.append(arrays.add(page[index[rows.numpy()]].astype(np.int32)))
    own = np.where(followers.own < 0, -1, at[followers.own])
    table = np.column_stack([place[followers.rows], followers.edits, own, at[followers.anchors]])
    return {
        "members": len(order),
        "segments": _segments(groups[order], order, parts),
        "sh": kept,
        "attributes": attributes,
        "edits": edits,
        "sphere": _sphere(kept),
        "picks": picks,
        "followers": arrays.add(table.astype(np.int32)),
        "weights": arrays.add(followers.weights.astype(np.float32)),
        "pushing": sorted(followers.pushing),
    }


def _sphere(kept: int) -> list[Any]:
    """Return the directions and weights at which a page grades colors of some SH coefficients."""
    return [_numbers(part.flatten()) for part in sphere(math.isqrt(kept + 1) - 1, torch.device("cpu"))]


def _finite(scene: Gaussians) -> Gaussians:
    """Return the scene with finite numbers. Rows with others, which no engine draws, become invisible."""
    flat = {name: torch.from_numpy(_table(getattr(scene, name).detach().numpy())) for name in ATTRIBUTES}
    flat["log_scales"] = flat["log_scales"].clamp(min=-1e4)
    unseen = ~torch.cat(list(flat.values()), dim=1).isfinite().all(dim=1)
    changed: dict[str, Any] = {name: table.nan_to_num(0.0, 0.0, 0.0) for name, table in flat.items()}
    changed["logit_opacities"] = changed["logit_opacities"].masked_fill(unseen[:, None], _UNSEEN_LOGIT)
    return replace(scene, **{name: changed[name].reshape(getattr(scene, name).shape) for name in ATTRIBUTES})


def _groups(count: int, regions: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return a number per row that is equal for rows of the same edits, 0 without any. [N]"""
    groups = np.zeros(count + 1, np.int64)  # one extra row, dropped below
    for members in regions:
        groups *= 2
        groups[members] += 1
        groups = np.unique(groups, return_inverse=True)[1]
    return groups[:-1]


def _order(scene: Gaussians, groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the rows in the page's order: members first, grouped by their edits, then by Morton code."""
    if not len(scene):
        return np.zeros(0, np.int64)
    order = morton_order(scene.means.sign() * scene.means.abs().log1p()).numpy()
    return order[np.argsort(-groups[order], kind="stable")]


def _segments(
    groups: NDArray[np.int64], order: NDArray[np.int64], gdfs: Sequence[Gdf]
) -> list[tuple[int, list[int]]]:
    """Return the runs of members with the same edits: length, at most `_MAX_SEGMENT`, and these edits."""
    starts = np.flatnonzero((np.diff(groups, prepend=-1) != 0) | (np.arange(len(groups)) % _MAX_SEGMENT == 0))
    inside = [np.isin(order[starts], gdf.region.members.numpy()) for gdf in gdfs]
    edits = [[i for i, there in enumerate(inside) if there[k]] for k in range(len(starts))]
    return list(zip(np.diff(starts, append=len(groups)).tolist(), edits, strict=True))


def _ascending(places: NDArray[np.int64]) -> Tensor:
    """Return the members on the page, in its order; the others have the position −1."""
    present = np.flatnonzero(places >= 0)
    return torch.from_numpy(present[np.argsort(places[present])])


def _scene_part(
    arrays: Arrays, name: str, values: NDArray[Any], exact: bool, moves: bool
) -> tuple[dict[str, Any], NDArray[Any]]:
    """Append rows of an attribute: float32, or 16 bits if an edit changes it and it is not a color, else 8
    bits."""
    if exact:
        return arrays.add(values.astype(np.float32)), values
    if name == "means":
        return arrays.add_levels(values, "i2", "log")
    if moves and name not in ("sh0", "shN"):
        return arrays.add_levels(values, "i2")
    if name == "quats":
        values = values / np.maximum(np.abs(values).max(axis=1, keepdims=True), 1e-30)
        levels = np.round(values * 127).astype(np.int8)
        return arrays.add(levels, scale=[1.0] * 4, zero=[0.0] * 4), levels
    if name == "logit_opacities":
        opacity = 1 / (1 + np.exp(-np.clip(values.astype(np.float64), -40, 40)))
        return arrays.add_levels(np.clip(opacity, 1 - _MAX_OPACITY, _MAX_OPACITY), "i1", "logit")
    if name == "log_scales" and len(values):
        values = np.maximum(values, values.max(axis=1).mean() + math.log(_MIN_AXIS_SHARE))
    return arrays.add_levels(values, "i1")


def _edit(
    arrays: Arrays,
    gdf: Gdf,
    order: Tensor,
    kept: int,
    exact: bool,
    shares: Mapping[str, Tensor] | None,
    split: ColorSplit | None,
) -> dict[str, Any]:
    """Append the arrays of an edit; return its header entry.

    Args:
        arrays: the container's arrays
        gdf: the edit
        order: its members in the order of the page. [m]
        kept: number of SH coefficients above the first
        exact: store float32
        shares: its coverage if another edit lies on its rows, see `coverage`
        split: its color apart from its texture, if the gains of a layer divide them
    """
    form = gdf.field.origin
    record: dict[str, Any] = {
        "name": gdf.name,
        "recorded": list(gdf.field.recorded),
        "pushes": [] if gdf.anchors is None else sorted(gdf.anchors.pushes),
        "leaves_paint": gdf.anchors is not None and gdf.anchors.leaves_paint,
        "knots": _numbers(gdf.field.knots),
        "attributes": _attributes(arrays, gdf.field, order, kept, exact),
    }
    if split is not None:
        record["split"] = _split(arrays, split, len(gdf.region), order, kept, exact)
    if shares is not None:
        covered = {kind: share[order].numpy() for kind, share in shares.items()}
        record["coverage"] = {
            kind: arrays.add(share) if exact else arrays.add_levels(share, "i1")[0]
            for kind, share in covered.items()
        }
        record["grade"] = _grade(arrays, form, order, kept) if isinstance(form, GradeForm) else None
    return record


def _attributes(
    arrays: Arrays, field: BakedField, order: Tensor, kept: int, exact: bool
) -> dict[str, dict[str, Any]]:
    """Append the attributes of a field, see `_edit`; return their header entries."""
    widths = {"shN": 3 * kept}
    return {
        name: _bases(arrays, name, bases, order, widths.get(name, bases.end_offset.shape[1]), exact)
        for name, bases in field.attributes.items()
        if widths.get(name, 1)
    }


def _split(
    arrays: Arrays, split: ColorSplit, members: int, order: Tensor, kept: int, exact: bool
) -> dict[str, Any]:
    """Append the color of an edit apart from its texture, see `_edit`; return its header entry."""
    discs = None
    if split.discs is not None:
        discs = []
        for values in (split.discs.change, split.discs.color):
            rows = torch.nn.functional.pad(values, (0, 0, members - len(values), 0))[order].numpy()
            discs.append(arrays.add(rows) if exact else arrays.add_levels(rows, "i2")[0])
    color = {} if split.color is None else _attributes(arrays, split.color, order, kept, exact)
    return {"color": color, "map_share": split.map_share, "discs": discs}


def _bases(
    arrays: Arrays, name: str, bases: AttributeBases, order: Tensor, width: int, exact: bool
) -> dict[str, Any]:
    """Append one attribute of an edit, its first `width` channels; return its header entry."""
    end = bases.end_offset[order, :width]
    scale = bases.scale[:, :width].clone()
    residual = bases.residual_basis[:, order, :width].float()
    if end.dtype == torch.float32 and not exact:
        levels, unit = quantize_bases((end * scale[0])[None], torch.int8 if name == "shN" else torch.int16)
        end = levels[0]
        scale[0] = unit[0]
    if bases.residual_basis.dtype == torch.int8:
        residual = bases.residual_basis[:, order, :width]
    elif not exact:
        residual, unit = quantize_bases(residual, torch.int8)
        scale[1:] *= unit
    return {
        "end": arrays.add(end.numpy()),
        "residual": [arrays.add(basis.numpy()) for basis in residual],
        "scale": _numbers(scale),
        "coefficients": _numbers(bases.coefficients),
    }


def _grade(arrays: Arrays, form: GradeForm, order: Tensor, kept: int) -> dict[str, Any]:
    """Append the map of a grade, for colors that lower layers have changed; return its header entry."""
    width = min(form.residual.shape[2], 3 + 3 * kept)
    return {
        "degree": form.degree,
        "knots": _numbers(form.knots),
        "table": [arrays.add(table.numpy()) for table in form.table],
        "residual": [arrays.add(basis[order, :width].numpy()) for basis in form.residual],
        "scale": _numbers(form.scale[:, :width]),
        "coefficients": _numbers(form.coefficients),
        "old": form.remap.old.tolist(),
        "new": form.remap.new.tolist(),
        "share": arrays.add(form.share[order].numpy()) if form.mask is not None else None,
    }


def _numbers(tensor: Tensor) -> Any:
    """Return float32 numbers with the fewest digits that identify them, nested like the tensor."""
    values = tensor.numpy()
    return [_numbers(row) for row in tensor] if values.ndim > 1 else [float(str(x)) for x in values]
