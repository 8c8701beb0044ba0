"""A scene and its edits as the bytes that a page reads (viewer/web/src/data.js).

Members of edits come first, so that a slider sends one run of rows, and near ones lie together. A container
is the length of its header, the header (JSON), and its arrays: channel after channel, the bytes of one weight
together, so that gzip finds what is alike.
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

from progdf.compose.reference import coverage
from progdf.field.baked import AttributeBases, GradeForm
from progdf.field.grade import sphere
from progdf.field.separable import quantize_bases
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import UNSEEN_LOGIT, Gdf

DRAWN_SH = (0, 3, 8, 15)
"""SH coefficients above the first, by degree."""
LEVELS = {"i1": 127, "i2": 32767}
_SMALLEST = 1e-4  # of the scene's spread: a smaller axis is less than a pixel of any picture of it
_OPAQUE = 1 - 1 / 512  # and its opposite: opacities that 8 bits end at


@dataclass
class Arrays:
    """Arrays of a container, in the order in which they were added."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0

    def add(self, values: NDArray[Any], **more: Any) -> dict[str, Any]:
        """Append an array [n] or [n,c]; what the header says of it."""
        table = np.ascontiguousarray(values.reshape(len(values), -1).T)
        table = table.astype(table.dtype.newbyteorder("<"))
        planes = table.reshape(-1, 1).view(np.uint8).T.tobytes()
        kind = f"{table.dtype.kind}{table.dtype.itemsize}"
        record = {"at": self.size, "type": kind, "rows": len(values), "width": len(table), **more}
        self.parts.append(planes)
        self.size += len(planes)
        return record

    def add_levels(self, values: NDArray[Any], kind: str, curve: str = "") -> dict[str, Any]:
        """Append numbers as levels between the least and the largest of each channel. [n,c] float

        Args:
            kind: of `LEVELS`
            curve: "log" for signed logarithms (1 + |x|), "logit" for opacities
        """
        table = values.reshape(len(values), -1).astype(np.float64)
        if curve == "log":
            table = np.sign(table) * np.log1p(np.abs(table))
        if not len(table):
            return self.add(table.astype("<i1"), scale=[1.0] * table.shape[1], zero=[0.0] * table.shape[1])
        low, high = table.min(axis=0), table.max(axis=0)
        zero, most = (low + high) / 2, LEVELS[kind]
        step = np.where(high > low, (high - low) / (2 * most), 1.0)
        levels = np.round((table - zero) / step).astype(f"<{kind}")
        return self.add(levels, scale=step.tolist(), zero=zero.tolist(), curve=curve)


def pack(scene: Gaussians, gdfs: Sequence[Gdf], quality: str, degree: int, more: Mapping[str, Any]) -> bytes:
    """The container of a scene and edits of it that add nothing any more.

    Args:
        scene: the original with the rows that edits add
        gdfs: its edits
        quality: "exact", float32 and the numbers of the edits' files, or "compact", 8 and 16 bits
        degree: of the spherical harmonics that stay, 0 to 3
        more: what else the header holds; in "paints" pairs of an edit and the weights of its members [M]
    """
    scene = _finite(scene)
    kept = min(DRAWN_SH[degree], scene.shN.shape[1])
    members = np.zeros(len(scene), bool)
    for gdf in gdfs:
        members[gdf.region.members.numpy()] = True
    order, count = _rows(scene, members), int(members.sum())
    place = np.full(len(scene), -1, np.int64)
    place[order] = np.arange(len(order))
    arrays, exact = Arrays(), quality == "exact"
    moved = {name for gdf in gdfs for name in gdf.field.attributes}
    attributes = {}
    for name in ATTRIBUTES:
        values = getattr(scene, name).detach().float()[torch.from_numpy(order)]
        values = (values[:, :kept] if name == "shN" else values).reshape(len(order), -1)
        if values.shape[1]:
            parts = (values[:count].numpy(), True), (values[count:].numpy(), False)
            attributes[name] = [
                _scene_part(arrays, name, part, exact, first and name in moved) for part, first in parts
            ]
    overlaps = len(gdfs) > 1 and sum(len(gdf.region) for gdf in gdfs) > count
    paints = []
    for edit, weights in more["paints"]:
        rows = np.argsort(place[gdfs[edit].region.members.numpy()])
        levels = np.round(weights.numpy()[rows] * 255).astype("<i2")
        paints.append(arrays.add(levels, scale=[1 / 255], zero=[0.0]))
    header = {
        **more,
        "paints": paints,
        "count": len(order),
        "members": count,
        "sh": kept,
        "antialiased": scene.antialiased,
        "attributes": attributes,
        "edits": [_edit(arrays, scene, gdf, place, kept, exact, overlaps) for gdf in gdfs],
        "sphere": [
            _numbers(part.flatten()) for part in sphere(math.isqrt(kept + 1) - 1, torch.device("cpu"))
        ],
    }
    text = json.dumps(header, ensure_ascii=True, allow_nan=False, separators=(",", ":")).encode()
    return len(text).to_bytes(4, "little") + text + b"".join(arrays.parts)


def _finite(scene: Gaussians) -> Gaussians:
    """The scene with finite numbers; rows that no engine draws for theirs are unseen."""
    flat = {name: getattr(scene, name).reshape(len(scene), -1) for name in ATTRIBUTES}
    flat["log_scales"] = flat["log_scales"].clamp(min=-1e4)
    unseen = ~torch.cat(list(flat.values()), dim=1).isfinite().all(dim=1)
    changed: dict[str, Any] = {name: table.nan_to_num(0.0, 0.0, 0.0) for name, table in flat.items()}
    changed["logit_opacities"] = changed["logit_opacities"].masked_fill(unseen[:, None], -1e3)
    return replace(scene, **{name: changed[name].reshape(getattr(scene, name).shape) for name in ATTRIBUTES})


def _rows(scene: Gaussians, members: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows in the page's order: members first, near ones together; what nobody can ever see is left out."""
    means = scene.means.numpy().astype(np.float64)
    small = np.sign(means) * np.log1p(np.abs(means))
    low = small.min(axis=0, initial=0.0)
    cells = ((small - low) / max(np.ptp(small) if len(small) else 0.0, 1e-12) * 1023).astype(np.int64)
    code = np.zeros(len(scene), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    seen = members | (scene.logit_opacities.numpy() >= UNSEEN_LOGIT)
    order = np.lexsort((code, ~members))
    return order[seen[order]]


def _scene_part(arrays: Arrays, name: str, values: NDArray[Any], exact: bool, moves: bool) -> dict[str, Any]:
    """Rows of an attribute: float32; or 16 bits where an edit moves what is no color, else 8."""
    if exact:
        return arrays.add(values.astype(np.float32))
    if name == "means":
        return arrays.add_levels(values, "i2", "log")
    if moves and name not in ("sh0", "shN"):
        return arrays.add_levels(values, "i2")
    if name == "quats":
        values = values / np.maximum(np.abs(values).max(axis=1, keepdims=True), 1e-30)
        return arrays.add(np.round(values * 127).astype(np.int8), scale=[1.0] * 4, zero=[0.0] * 4)
    if name == "logit_opacities":
        opacity = 1 / (1 + np.exp(-np.clip(values.astype(np.float64), -40, 40)))
        return arrays.add_levels(np.clip(opacity, 1 - _OPAQUE, _OPAQUE), "i1", "logit")
    if name == "log_scales" and len(values):
        values = np.maximum(values, values.max(axis=1).mean() + math.log(_SMALLEST))
    return arrays.add_levels(values, "i1")


def _edit(
    arrays: Arrays,
    scene: Gaussians,
    gdf: Gdf,
    place: NDArray[np.int64],
    kept: int,
    exact: bool,
    overlaps: bool,
) -> dict[str, Any]:
    """An edit in the header; its members ascend in the page's order."""
    rows = place[gdf.region.members.numpy()]
    order = torch.from_numpy(np.argsort(rows))
    form, widths = gdf.field.origin, {"shN": 3 * kept}
    record: dict[str, Any] = {
        "name": gdf.name,
        "recorded": list(gdf.field.recorded),
        "knots": _numbers(gdf.field.knots),
        "members": arrays.add(np.diff(np.sort(rows), prepend=0).astype("<i4")),
        "attributes": {
            name: _bases(arrays, name, bases, order, widths.get(name, bases.end_offset.shape[1]), exact)
            for name, bases in gdf.field.attributes.items()
            if widths.get(name, 1)
        },
    }
    if overlaps:
        shares = {kind: share[order].numpy() for kind, share in coverage(scene, gdf).items()}
        record["coverage"] = {
            kind: arrays.add(share) if exact else arrays.add_levels(share[:, None], "i1")
            for kind, share in shares.items()
        }
        record["grade"] = _grade(arrays, form, order, kept) if isinstance(form, GradeForm) else None
    return record


def _bases(
    arrays: Arrays, name: str, bases: AttributeBases, order: Tensor, width: int, exact: bool
) -> dict[str, Any]:
    """One attribute of an edit, its first `width` channels."""
    end, scale = bases.end_offset[order, :width], bases.scale[:, :width].clone()
    residual = bases.residual_basis[:, order, :width].float()
    if end.dtype == torch.float32 and not exact:
        levels, unit = quantize_bases((end * scale[0])[None], torch.int8 if name == "shN" else torch.int16)
        end, scale[0] = levels[0], unit[0]
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
    """The map of a grade, for colors that others have changed."""
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
    """float32 numbers as few digits as tell them apart, nested as the tensor is."""
    values = tensor.numpy()
    return [_numbers(row) for row in tensor] if values.ndim > 1 else [float(str(x)) for x in values]
