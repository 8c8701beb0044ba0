"""Reference composition of moves, the parents of other layers (docs/method.md 6).

A move is an edit with known motions (see `progdf.gdf.motions`). The other layers are composed first. Then
each move acts on the result, the lowest first. The symbols are

    Δ, f     offsets of the move; its weight times its gain
    L        linear map of the move
    x0, x    a member in the original; the same member below the move

and the moved member is

    means        x' = x0 + f Δ + (x − x0) + f (L − I) (x − x0)
    quaternions  q' = q0 + f Δ + (q − q0) + f (r − 1) (q − q0), with r the rotation of L, if L is a similarity
    log-scales   l' = l0 + f Δ + (l − l0), if L is a similarity
    higher bands b' = b0 + f Δ + (b − b0) + f (D − I) (b − b0), with D the rotation of the bands

If L is no similarity, log-scales and quaternions are those of the covariance L Σ Lᵀ, blended with those of x
by f.

So a member that no other layer changes is x0 + f Δ bit for bit, and a changed one is the motion of the
changed Gaussian. An added row follows the motions of its anchors: x' = x + Σ w f (a0 + Δ + L (x − a0) − x).

Opacity, and the color of band 0, are never carried.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from progdf.compose.layers import Layer
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.motions import LinearMap, linear_map
from progdf.quaternions import multiply_quats
from progdf.similarity import stretch_axes
from progdf.system.equality import equal_fields

MOVED = ("means", "log_scales", "quats", "shN")
"""Attributes that a move changes and carries."""
SHAPE = MOVED[:3]
"""Attributes of the geometry among them."""

_SHAPE_ROUNDING = 1e-6  # largest rounding error of a log-scale or of a quaternion's component

Rows = dict[str, Tensor]
"""Moved attributes of some rows, flat. [R,c] float32 each"""


def is_move(gdf: Gdf) -> bool:
    """Return whether an edit carries other layers."""
    return gdf.motions is not None


def still(gdf: Gdf) -> Gdf:
    """Return a move without its motion, and any other edit unchanged."""
    if gdf.motions is None:
        return gdf
    attributes = {name: bases for name, bases in gdf.field.attributes.items() if name not in MOVED}
    return replace(gdf, field=replace(gdf.field, attributes=attributes), motions=None)


def leaves_rows(gdf: Gdf) -> bool:
    """Return whether a move leaves the rows that other edits add on its members in place."""
    return gdf.anchors is not None and not gdf.anchors.carries_others


@dataclass(frozen=True)
class Anchored:
    """Rows that an edit adds, and the anchors of each among the members of a move."""

    __eq__ = equal_fields

    rows: Tensor  # rows of the scene. [R]
    members: Tensor  # index of the member that each anchor is; those with weight 0 have no meaning. [R,4]
    weights: Tensor  # weights of these anchors; 0 for those that the move leaves in place. [R,4] float64


def anchored_rows(gdf: Gdf, move: Gdf) -> Anchored | None:
    """Return the rows of an edit that follow a move; None if there are none.

    Args:
        gdf, move: edits of the extended scene
    """
    anchors = gdf.anchors
    if gdf is move or anchors is None or not len(anchors) or leaves_rows(move) or not len(move.region):
        return None
    members = move.region.members
    at = torch.searchsorted(members, anchors.rows).clamp(max=len(members) - 1)
    weights = anchors.weights.double()
    total = weights.sum(dim=1, keepdim=True)
    weights = torch.where(members[at] == anchors.rows, weights / total.clamp_min(1e-9), 0.0)
    found = (weights > 0.0).any(dim=1).nonzero()[:, 0]
    if not len(found):
        return None
    rows = gdf.region.members[len(gdf.region) - len(anchors) :]
    return Anchored(rows[found], at[found], weights[found])


def part_maps(layer: Layer, bands: int) -> list[LinearMap]:
    """Return the linear map of each part of a move at its layer's strength; `bands`: see `linear_map`."""
    assert layer.gdf.motions is not None
    return [linear_map(part, layer.strength, bands) for part in layer.gdf.motions.motions]


def carry(scene: Gaussians, composed: Gaussians, layers: Sequence[Layer]) -> Gaussians:
    """Return the composed scene after the moves among its layers.

    Args:
        scene: the original with the rows that edits add
        composed: the scene under the layers without their motions, see `still`
        layers: active layers of converted edits, lowest first
    """
    moves = [layer for layer in layers if is_move(layer.gdf)]
    if not moves:
        return composed
    original = {name: getattr(scene, name).float().flatten(1) for name in MOVED}
    now = {name: getattr(composed, name).float().flatten(1).clone() for name in MOVED}
    for layer in moves:
        maps = part_maps(layer, scene.shN.shape[1])
        count = len(layer.gdf.region)
        weights = torch.ones(count) if layer.weights is None else layer.weights.float()
        offsets = {
            name: layer.gdf.field.attribute_offsets(name, layer.strength)
            for name in layer.gdf.field.attributes
            if name in MOVED
        }
        added = []
        for gdf in {id(each.gdf): each.gdf for each in layers}.values():
            found = anchored_rows(gdf, layer.gdf)
            if found is not None:
                added.append((found, carry_added(original, now, found, layer, maps, offsets, weights)))
        chosen = weights.nonzero()[:, 0]
        own = {name: each[chosen] for name, each in offsets.items()}
        carried = carry_members(original, now, chosen, layer, maps, own, weights)
        for name, values in carried.items():
            now[name][layer.gdf.region.members[chosen]] = values
        for found, rows in added:
            for name, values in rows.items():
                now[name][found.rows] = values
    changed: dict[str, Any] = {}
    for name, values in now.items():
        shaped = values.reshape(getattr(scene, name).shape).to(getattr(scene, name).dtype)
        if not torch.equal(shaped, getattr(composed, name)):
            changed[name] = shaped
    return replace(composed, **changed)


def carry_members(
    original: Mapping[str, Tensor],
    now: Mapping[str, Tensor],
    chosen: Tensor,
    layer: Layer,
    maps: Sequence[LinearMap],
    offsets: Mapping[str, Tensor],
    weights: Tensor,
) -> Rows:
    """Return members of a move after it.

    Args:
        original, now: moved attributes of the scene, in the original and below the move. [N,c]
        chosen: indices of the members to return. [m]
        layer: the layer of the move
        maps: see `part_maps`
        offsets: offsets of these members by attribute; absent ones are unchanged. [m,c]
        weights: weights of all members. [M] float32
    """
    assert layer.gdf.motions is not None
    rows = layer.gdf.region.members[chosen]
    carried: Rows = {}
    displaced: dict[str, Tensor] = {}
    for name in MOVED:
        below = now[name][rows]
        displaced[name] = (below != original[name][rows]).any(dim=1)
        carried[name] = below
        if name in offsets:
            factor = weights[chosen, None] * torch.tensor(layer.gain(name))
            carried[name] = below + factor * offsets[name]
    part_of = torch.zeros(len(layer.gdf.region), dtype=torch.int64)
    part_of[: len(layer.gdf.motions.parts)] = layer.gdf.motions.parts
    in_region = chosen < len(layer.gdf.motions.parts)
    for part, each in enumerate(maps):
        is_part = in_region & (part_of[chosen] == part)
        if each.is_identity or not bool(is_part.any()):
            continue
        changed = {name: differs & is_part for name, differs in displaced.items()}
        _carry_displaced(original, now, _Displaced(rows, changed, weights[chosen], each), layer, carried)
    return carried


@dataclass(frozen=True)
class _Displaced:
    """Members of one part of a move that other layers have changed."""

    __eq__ = equal_fields

    rows: Tensor  # rows of the chosen members. [m]
    changed: Mapping[str, Tensor]  # those of them that are in the part and have changed, by attribute. [m]
    weights: Tensor  # weights of the chosen members. [m]
    linear: LinearMap  # map of the part


def _carry_displaced(
    original: Mapping[str, Tensor],
    now: Mapping[str, Tensor],
    part: _Displaced,
    layer: Layer,
    carried: Rows,
) -> None:
    """Carry changed members in place; arguments as in `carry_members`."""
    rows = part.rows
    weights = part.weights
    linear = part.linear
    shift = part.changed["means"].nonzero()[:, 0]
    if len(shift):
        at = rows[shift]
        change = now["means"][at].double() - original["means"][at].double()
        factor = weights[shift, None].double() * layer.gain("means")
        extra = factor * (change @ (linear.matrix.T - torch.eye(3, dtype=torch.float64)))
        carried["means"][shift] = (carried["means"][shift].double() + extra).float()
    is_shaped = part.changed["log_scales"] | part.changed["quats"]
    if not linear.is_similar:
        is_shaped &= _changes_shape(original, now, rows)
    shaped = is_shaped.nonzero()[:, 0]
    if len(shaped):
        at = rows[shaped]
        factor = weights[shaped, None].double() * layer.gain("quats")
        quats = now["quats"][at].double()
        if linear.is_similar:
            change = quats - original["quats"][at].double()
            extra = factor * (multiply_quats(linear.turn[None].expand(len(at), 4), change) - change)
            carried["quats"][shaped] = (carried["quats"][shaped].double() + extra).float()
        else:
            log_scales = now["log_scales"][at].double()
            new_scales, new_quats = stretch_axes(log_scales, quats, linear.shape)
            carried["log_scales"][shaped] = torch.lerp(log_scales, new_scales, factor).float()
            carried["quats"][shaped] = torch.lerp(quats, new_quats, factor).float()
    turned = part.changed["shN"].nonzero()[:, 0]
    if len(turned) and len(linear.bands):
        at = rows[turned]
        change = now["shN"][at].double() - original["shN"][at].double()
        factor = weights[turned, None].double() * layer.gain("shN")
        extra = factor * map_bands(change, linear)
        carried["shN"][turned] = (carried["shN"][turned].double() + extra).float()


def _changes_shape(original: Mapping[str, Tensor], now: Mapping[str, Tensor], rows: Tensor) -> Tensor:
    """Return the rows whose shape differs by more than the rounding of the layers below. [R] bool"""
    differs = torch.zeros(len(rows), dtype=torch.bool)
    for name in ("log_scales", "quats"):
        differs |= ((now[name][rows] - original[name][rows]).abs() > _SHAPE_ROUNDING).any(dim=1)
    return differs


def carry_added(
    original: Mapping[str, Tensor],
    now: Mapping[str, Tensor],
    added: Anchored,
    layer: Layer,
    maps: Sequence[LinearMap],
    offsets: Mapping[str, Tensor],
    weights: Tensor,
) -> Rows:
    """Return added rows after a move of their anchors.

    Args:
        added: rows and their anchors
        offsets: offsets of all members by attribute; absent ones are unchanged. [M,c]
        original, now, layer, maps, weights: as in `carry_members`
    """
    motions = layer.gdf.motions
    assert motions is not None
    own = {name: now[name][added.rows].double() for name in MOVED}
    anchor_rows = layer.gdf.region.members[added.members]
    at = original["means"][anchor_rows].double()
    target = at
    if "means" in offsets:
        target = at + offsets["means"][added.members].double()
    parts = motions.parts[added.members.clamp(max=len(motions.parts) - 1)]
    held = added.weights * weights[added.members].double()
    totals = dict(own)
    for part, each in enumerate(maps):
        share = held * (parts == part)
        if not bool(share.any()):
            continue
        moved = target + (own["means"][:, None] - at) @ each.matrix.T - own["means"][:, None]
        steps = (share * layer.gain("means"))[..., None] * moved
        totals["means"] = totals["means"] + steps.sum(dim=1)
        if each.is_identity:
            continue
        factor = share.sum(dim=1, keepdim=True)
        log_scales, quats = map_shapes(own["log_scales"], own["quats"], each)
        geometry = factor * layer.gain("quats")
        totals["log_scales"] = totals["log_scales"] + geometry * (log_scales - own["log_scales"])
        totals["quats"] = totals["quats"] + geometry * (quats - own["quats"])
        if len(each.bands):
            colors = factor * layer.gain("shN")
            totals["shN"] = totals["shN"] + colors * map_bands(own["shN"], each)
    return {name: values.float() for name, values in totals.items()}


def map_shapes(log_scales: Tensor, quats: Tensor, linear: LinearMap) -> tuple[Tensor, Tensor]:
    """Return log-scales and quaternions of Gaussians after a linear map. [R,3], [R,4] float64"""
    if not linear.is_similar:
        return stretch_axes(log_scales, quats, linear.shape)
    return log_scales + linear.log_scale, multiply_quats(linear.turn[None].expand(len(quats), 4), quats)


def map_bands(bands: Tensor, linear: LinearMap) -> Tensor:
    """Return the change of higher SH bands by a linear map. [R,3K] -> [R,3K]"""
    count = len(linear.bands)
    change = linear.bands - torch.eye(count, dtype=torch.float64)
    by_band = bands.reshape(len(bands), count, 3)
    return torch.einsum("ij,njc->nic", change, by_band).flatten(1)
