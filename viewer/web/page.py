"""A scene and its edits as one HTML file that shows them and moves their sliders, and that fetches nothing.

The page reads a container (src/data.js): the length of its header, the header (JSON), and its arrays, channel
after channel, the bytes of one weight together, so that gzip finds what is alike. Members of edits come
first, those of the same edits together, so that a slider sends few runs of rows, and near ones lie together.
The script is src/*.js put one after another, the shaders are the viewer's own, and the policy in the page's
head lets nothing else run: a .gdf's names are a stranger's text.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf import __version__
from progdf.color.edits import hex_color
from progdf.compose.reference import coverage
from progdf.errors import ProgdfError
from progdf.field.baked import AttributeBases, GradeForm
from progdf.field.grade import sphere
from progdf.field.separable import quantize_bases
from progdf.formats.packed.compressed_ply import morton_order
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import UNSEEN_LOGIT, Gdf
from progdf.io.images import to_picture
from shaders import load_source

DRAWN_SH = (0, 3, 8, 15)
"""SH coefficients above the first, by degree."""
LEVELS = {"i1": 127, "i2": 32767}
_SEGMENT = 1 << 12  # members that are composed at once, which bounds the memory for that
_SMALLEST = 1e-4  # of the scene's spread: a smaller axis is less than a pixel of any picture of it
_UNSEEN = -1e3  # a logit
_OPAQUE = 1 - 1 / 512  # and its opposite: opacities that 8 bits end at


@dataclass
class Arrays:
    """Arrays of a container, in the order in which they were added."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0

    def add(self, values: NDArray[Any], **more: Any) -> dict[str, Any]:
        """Append an array [n] or [n,c]; what the header says of it."""
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
        """Append numbers as levels between the least and the largest of each channel. [n,c] float

        Args:
            kind: of `LEVELS`
            curve: "log" for signed logarithms (1 + |x|), "logit" for opacities

        Returns:
            What the header says of it, and what the page makes of it.
        """
        table = _table(values).astype(np.float64)
        if curve == "log":
            table = np.sign(table) * np.log1p(np.abs(table))
        some = table if len(table) else np.zeros((1, table.shape[1]))
        low = some.min(axis=0)
        high = some.max(axis=0)
        zero = (low + high) / 2
        most = LEVELS[kind]
        step = np.where(high > low, (high - low) / (2 * most), 1.0)
        levels = np.round((table - zero) / step).astype(f"<{kind}")
        made = zero + step * levels
        if curve == "log":
            made = np.sign(made) * np.expm1(np.abs(made))
        elif curve == "logit":
            made = np.log(made / (1 - made))
        return self.add(levels, scale=step.tolist(), zero=zero.tolist(), curve=curve), made


def _table(values: NDArray[Any]) -> NDArray[Any]:
    """[n] or [n,…] -> [n,c]"""
    return values.reshape(len(values), math.prod(values.shape[1:]))


@dataclass(frozen=True)
class Packed:
    """What a page holds."""

    data: bytes  # the container
    scene: Gaussians  # the original as the page has it, in its own order; what was left out is unseen


def pack(
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    quality: str,
    degree: int,
    more: Mapping[str, Any],
) -> Packed:
    """The container of a scene and edits of it that add nothing any more.

    Args:
        scene: the original with the rows that edits add
        gdfs: its edits
        quality: "exact", float32 and the numbers of the edits' files, or "compact", 8 and 16 bits
        degree: of the spherical harmonics that stay, 0 to 3
        more: what else the header holds; in "paints" pairs of an edit and the weights of its members [M]

    Raises:
        ProgdfError: there is no such quality.
    """
    if quality not in ("exact", "compact"):
        raise ProgdfError(f"unknown quality '{quality}'; use exact or compact")
    scene, kept = _finite(scene), min(DRAWN_SH[degree], scene.shN.shape[1])
    groups = _groups(len(scene), [gdf.region.members.numpy() for gdf in gdfs])
    seen = (groups > 0) | (scene.logit_opacities.numpy() >= UNSEEN_LOGIT)
    order = _order(scene, groups)
    order = order[seen[order]]
    count = int((groups[order] > 0).sum())
    place = np.full(len(scene), -1, np.int64)
    place[order] = np.arange(len(order))
    inside = [_ascending(place[gdf.region.members.numpy()]) for gdf in gdfs]
    arrays = Arrays()
    exact = quality == "exact"
    attributes, made = _scene(arrays, scene, gdfs, order, count, kept, exact)
    overlaps = len(gdfs) > 1 and sum(map(len, inside)) > count
    paints = []
    for edit, weights in more["paints"]:
        levels = np.round(weights[inside[edit]].numpy() * 255).astype("<i2")
        paints.append(arrays.add(levels, scale=[1 / 255], zero=[0.0]))
    header = {
        **more,
        "paints": paints,
        "count": len(order),
        "members": count,
        "segments": _segments(groups[order[:count]], order, gdfs),
        "sh": kept,
        "antialiased": scene.antialiased,
        "attributes": attributes,
        "edits": [
            _edit(arrays, scene, gdf, rows, kept, exact, overlaps)
            for gdf, rows in zip(gdfs, inside, strict=True)
        ],
        "sphere": [
            _numbers(part.flatten()) for part in sphere(math.isqrt(kept + 1) - 1, torch.device("cpu"))
        ],
    }
    text = json.dumps(header, ensure_ascii=True, allow_nan=False, separators=(",", ":")).encode()
    return Packed(len(text).to_bytes(4, "little") + text + b"".join(arrays.parts), made)


def _scene(
    arrays: Arrays,
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    order: NDArray[np.int64],
    count: int,
    kept: int,
    exact: bool,
) -> tuple[dict[str, Any], Gaussians]:
    """The attributes in the header, the first `count` rows apart, and the scene as they have it."""
    moved = {name for gdf in gdfs for name in gdf.field.attributes}
    attributes: dict[str, Any] = {}
    changed: dict[str, Any] = {"shN": torch.zeros_like(scene.shN)}
    changed["logit_opacities"] = torch.full_like(scene.logit_opacities, _UNSEEN)
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


def _finite(scene: Gaussians) -> Gaussians:
    """The scene with finite numbers; rows that no engine draws for theirs are unseen."""
    flat = {name: torch.from_numpy(_table(getattr(scene, name).detach().numpy())) for name in ATTRIBUTES}
    flat["log_scales"] = flat["log_scales"].clamp(min=-1e4)
    unseen = ~torch.cat(list(flat.values()), dim=1).isfinite().all(dim=1)
    changed: dict[str, Any] = {name: table.nan_to_num(0.0, 0.0, 0.0) for name, table in flat.items()}
    changed["logit_opacities"] = changed["logit_opacities"].masked_fill(unseen[:, None], _UNSEEN)
    return replace(scene, **{name: changed[name].reshape(getattr(scene, name).shape) for name in ATTRIBUTES})


def _groups(count: int, regions: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """A number for each row, alike where the same edits have it, 0 where none. [N]"""
    groups = np.zeros(count + 1, np.int64)  # one more row, which is nobody's
    for members in regions:
        groups *= 2
        groups[members] += 1
        groups = np.unique(groups, return_inverse=True)[1]
    return groups[:-1]


def _order(scene: Gaussians, groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows in the page's order: members first, those of the same edits and near ones together (by Morton's
    code)."""
    if not len(scene):
        return np.zeros(0, np.int64)
    order = morton_order(scene.means.sign() * scene.means.abs().log1p()).numpy()
    return order[np.argsort(-groups[order], kind="stable")]


def _segments(
    groups: NDArray[np.int64], order: NDArray[np.int64], gdfs: Sequence[Gdf]
) -> list[tuple[int, list[int]]]:
    """How many members in turn belong to the same edits, at most `_SEGMENT`, and to which."""
    starts = np.flatnonzero((np.diff(groups, prepend=-1) != 0) | (np.arange(len(groups)) % _SEGMENT == 0))
    inside = [np.isin(order[starts], gdf.region.members.numpy()) for gdf in gdfs]
    edits = [[i for i, there in enumerate(inside) if there[k]] for k in range(len(starts))]
    return list(zip(np.diff(starts, append=len(groups)).tolist(), edits, strict=True))


def _ascending(places: NDArray[np.int64]) -> Tensor:
    """Which members are on the page, in its order; those that are not have the place −1."""
    there = np.flatnonzero(places >= 0)
    return torch.from_numpy(there[np.argsort(places[there])])


def _scene_part(
    arrays: Arrays, name: str, values: NDArray[Any], exact: bool, moves: bool
) -> tuple[dict[str, Any], NDArray[Any]]:
    """Rows of an attribute: float32; or 16 bits where an edit moves what is no color, else 8."""
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
        return arrays.add_levels(np.clip(opacity, 1 - _OPAQUE, _OPAQUE), "i1", "logit")
    if name == "log_scales" and len(values):
        values = np.maximum(values, values.max(axis=1).mean() + math.log(_SMALLEST))
    return arrays.add_levels(values, "i1")


def _edit(
    arrays: Arrays,
    scene: Gaussians,
    gdf: Gdf,
    order: Tensor,
    kept: int,
    exact: bool,
    overlaps: bool,
) -> dict[str, Any]:
    """An edit in the header, and its members in this order."""
    form = gdf.field.origin
    widths = {"shN": 3 * kept}
    record: dict[str, Any] = {
        "name": gdf.name,
        "recorded": list(gdf.field.recorded),
        "knots": _numbers(gdf.field.knots),
        "attributes": {
            name: _bases(arrays, name, bases, order, widths.get(name, bases.end_offset.shape[1]), exact)
            for name, bases in gdf.field.attributes.items()
            if widths.get(name, 1)
        },
    }
    if overlaps:
        shares = {kind: share[order].numpy() for kind, share in coverage(scene, gdf).items()}
        record["coverage"] = {
            kind: arrays.add(share) if exact else arrays.add_levels(share, "i1")[0]
            for kind, share in shares.items()
        }
        record["grade"] = _grade(arrays, form, order, kept) if isinstance(form, GradeForm) else None
    return record


def _bases(
    arrays: Arrays, name: str, bases: AttributeBases, order: Tensor, width: int, exact: bool
) -> dict[str, Any]:
    """One attribute of an edit, its first `width` channels."""
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


MODULES = ("camera", "data", "grade", "compose", "sort", "renderer", "state", "panel", "input", "main")
"""Of `src`, each after those that it imports when it is read; then comes what the page is shown in."""
STAGES = ("web.vert", "splat.frag", "present.vert", "present.frag", "stretch.frag")
MAIL = 25e6
HOST = 100e6
"""Bytes: what mail takes, and common hosts."""

_IMPORT = re.compile(r"^import .*?;\n", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"https?://[^\s<>\"']+[^\s<>\"'.,;:)]")


def join(modules: Sequence[str] = (*MODULES, "start"), then: str = "") -> str:
    """Modules of `src` one after another, and what follows them, in a function of their own."""
    parts = [_source(f"{name}.js") for name in modules]
    joined = "\n".join(re.sub(r"^export ", "", _IMPORT.sub("", part), flags=re.MULTILINE) for part in parts)
    return f'(() => {{\n"use strict";\n{joined}{then}}})();\n'


def build_widget() -> str:
    """The module with which anywidget shows the page in a cell, see viewer/web/src/widget.js."""
    made = join((*MODULES, "widget"), f"return (view) => render(view, {in_script(_shaders())});\n")
    return f"const render = {made}export default {{ render }};\n"


@dataclass(frozen=True)
class PageTexts:
    """What a page shows besides its scene."""

    title: str  # above the sliders and of the browser's tab
    credit: str  # below them, with addresses as links
    background: tuple[float, float, float]  # behind the scene, 0..1
    still: Tensor  # what shows until the scene is there, and where WebGL2 is not, 0..1. [H,W,3]

    @property
    def style(self) -> str:
        """The style sheet."""
        return f":root, :host {{ --behind: {hex_color(self.background)}; }}\n{_source('page.css')}"

    @property
    def body(self) -> str:
        """The elements that the script fills."""
        picture = io.BytesIO()
        to_picture(self.still).save(picture, "WEBP", quality=82)
        still = "data:image/webp;base64," + base64.b64encode(picture.getvalue()).decode()
        texts = {"title": html.escape(self.title), "credit": _with_links(self.credit), "still": still}
        return _fill("body.html", texts)

    @property
    def markup(self) -> str:
        """The page in an element of its own, with its style, for a shadow root."""
        return f'<style>{self.style}</style>\n<div class="page">\n{self.body}</div>'


def build_page(container: bytes, texts: PageTexts) -> str:
    """The page of a container, see `pack`, as a file of its own."""
    style = texts.style
    code = join()
    parts = {
        "title": html.escape(texts.title),
        "version": __version__,
        "style": style,
        "style_hash": _hash(style),
        "body": texts.body,
        "script": code,
        "script_hash": _hash(code),
        "shaders": in_script(_shaders()),
        "data": base64.b64encode(gzip.compress(container, 9, mtime=0)).decode(),
    }
    return _fill("page.html", parts)


def _source(name: str) -> str:
    return (resources.files("viewer.web") / "src" / name).read_text(encoding="utf-8")


def _shaders() -> dict[str, str]:
    return {name: _body(load_source(name).text) for name in STAGES}


def _fill(template: str, texts: Mapping[str, str]) -> str:
    return re.sub(r"\{\{(\w+)\}\}", lambda found: texts[found[1]], _source(template))


def in_script(value: Mapping[str, Any]) -> str:
    """JSON that ends no script element, whatever its texts are."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def _body(source: str) -> str:
    """A stage without its version, which the page puts in front, and without comments."""
    text = re.sub(r"//[^\n]*", "", source.removeprefix("#version 330 core"))
    return "\n" + "\n".join(line.rstrip() for line in text.splitlines() if line.strip())


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _with_links(text: str) -> str:
    parts = []
    at = 0
    for found in _LINK.finditer(text):
        address = html.escape(found[0])
        parts += [html.escape(text[at : found.start()])]
        parts += [f'<a href="{address}" rel="noopener noreferrer" target="_blank">{address}</a>']
        at = found.end()
    return "".join([*parts, html.escape(text[at:])])
