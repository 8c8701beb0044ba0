"""Rest frame of moved members: changes that are made to the moved scene, as a child of its moves.

A pull in the window deforms the scene that is on screen. Its layer is a child of the moves of the scene,
which carry its offsets. So the offsets are turned back before they are stored, see `rows` in this folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers
from progdf.gaussians import BASE_CHANNELS, Gaussians, attribute_slices, pack
from progdf.gdf.motions import LinearMap
from progdf.quaternions import multiply_quats
from progdf.similarity import stretch_axes
from progdf.system.equality import equal_fields

from .rows import is_move, part_maps, still

_FLAT = 1e-2  # smallest factor of a direction, relative to the largest, that is turned back
_WEIGHT_LEVELS = 255  # painted weights are stored in 8 bits
_COLUMNS = attribute_slices(BASE_CHANNELS)
_MEANS = _COLUMNS["means"]
_LOG_SCALES = _COLUMNS["log_scales"]
_QUATS = _COLUMNS["quats"]
_BANDS = slice(BASE_CHANNELS, None)


@dataclass(frozen=True)
class RestFrame:
    """Inverse motions of M members, for G groups of members that the moves treat alike."""

    __eq__ = equal_fields

    group: Tensor  # group of each member. [M] int64
    matrices: Tensor  # inverse maps of differences of positions. [G,3,3] float64
    shapes: Tensor  # inverse maps of covariances. [G,3,3]
    quats: Tensor  # quaternions that turn back. [G,4]
    bands: Tensor  # inverse matrices of the higher SH bands. [G,K,K]
    is_similar: Tensor  # the maps of these groups keep proportions. [G] bool
    shown: Tensor  # geometry of the members on screen. [M,10]
    rest: Tensor  # geometry of the members without the moves. [M,10]

    def offsets(self, shown_offsets: Tensor) -> Tensor:
        """Return offsets for the rest frame that have the given effect on screen. [M,C] -> [M,C]"""
        offsets = shown_offsets.double().clone()
        offsets[:, _MEANS] = torch.einsum("mij,mj->mi", self.matrices[self.group], offsets[:, _MEANS])
        offsets[:, _QUATS] = multiply_quats(self.quats[self.group], offsets[:, _QUATS])
        shapes = torch.cat([shown_offsets[:, _LOG_SCALES], shown_offsets[:, _QUATS]], dim=1)
        changed = (shapes != 0).any(dim=1)
        for group in (~self.is_similar).nonzero()[:, 0].tolist():
            rows = (changed & (self.group == group)).nonzero()[:, 0]
            pulled = self.shown[rows] + shown_offsets[rows, : _QUATS.stop].double()
            log_scales, quats = stretch_axes(pulled[:, _LOG_SCALES], pulled[:, _QUATS], self.shapes[group])
            offsets[rows, _LOG_SCALES] = log_scales - self.rest[rows, _LOG_SCALES]
            offsets[rows, _QUATS] = quats - self.rest[rows, _QUATS]
        if offsets.shape[1] > BASE_CHANNELS:
            bands = offsets[:, _BANDS].reshape(len(offsets), -1, 3)
            turned = torch.einsum("mij,mjc->mic", self.bands[self.group], bands)
            offsets[:, _BANDS] = turned.flatten(1)
        return offsets.to(shown_offsets.dtype)


def rest_frame(scene: Gaussians, layers: Sequence[Layer], blend: str, members: Tensor) -> RestFrame | None:
    """Return the rest frame of some rows of the scene; None if no move turns, scales or mirrors them.

    Args:
        scene: the original
        layers: the stack, lowest first
        blend: one of `progdf.compose.layers.BLENDS`
        members: sorted rows of the scene. [M] int64
    """
    moves = [layer for layer in layers if layer.active and is_move(layer.gdf)]
    if not moves:
        return None
    bands = scene.shN.shape[1]
    keys = torch.zeros(len(members), 2 * len(moves), dtype=torch.int64)
    maps = [part_maps(layer, bands) for layer in moves]
    for k, layer in enumerate(moves):
        keys[:, 2 * k : 2 * k + 2] = _parts_of(layer, members)
    alike, group = torch.unique(keys, dim=0, return_inverse=True)
    found = [_inverse(moves, maps, row, bands) for row in alike.tolist()]
    if all(each is None for each in found):
        return None
    still_map = _Inverse.still(bands)
    inverses = [still_map if each is None else each for each in found]
    quiet = [replace(layer, gdf=still(layer.gdf)) for layer in layers]
    geometry = slice(0, _QUATS.stop)
    return RestFrame(
        group=group,
        matrices=torch.stack([each.matrix for each in inverses]),
        shapes=torch.stack([each.shape for each in inverses]),
        quats=torch.stack([each.quat for each in inverses]),
        bands=torch.stack([each.bands for each in inverses]),
        is_similar=torch.tensor([each.is_similar for each in inverses]),
        shown=pack(compose_layers(scene, layers, blend)[members])[:, geometry].double(),
        rest=pack(compose_layers(scene, quiet, blend)[members])[:, geometry].double(),
    )


@dataclass(frozen=True)
class _Inverse:
    """Inverse of the moves of one group."""

    __eq__ = equal_fields

    matrix: Tensor
    shape: Tensor
    quat: Tensor
    bands: Tensor
    is_similar: bool

    @staticmethod
    def still(bands: int) -> _Inverse:
        """Return the inverse of no move."""
        axes = torch.eye(3, dtype=torch.float64)
        quat = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        return _Inverse(axes, axes, quat, torch.eye(bands, dtype=torch.float64), True)


def _parts_of(layer: Layer, members: Tensor) -> Tensor:
    """Return the part of each row in a move, −1 for none, and its weight in `_WEIGHT_LEVELS`. [M,2]"""
    gdf = layer.gdf
    assert gdf.motions is not None
    count = len(gdf.motions.parts)
    rows = gdf.region.members[:count]
    keys = torch.zeros(len(members), 2, dtype=torch.int64)
    keys[:, 0] = -1
    if not count:
        return keys
    at = torch.searchsorted(rows, members).clamp(max=count - 1)
    is_member = rows[at] == members
    weights = torch.ones(count) if layer.weights is None else layer.weights[:count].float()
    levels = (weights[at] * _WEIGHT_LEVELS).round().long()
    keys[:, 0] = torch.where(is_member & (levels > 0), gdf.motions.parts[at], -1)
    keys[:, 1] = torch.where(keys[:, 0] >= 0, levels, 0)
    return keys


def _inverse(
    moves: Sequence[Layer], maps: Sequence[Sequence[LinearMap]], key: Sequence[int], bands: int
) -> _Inverse | None:
    """Return the inverse of the moves of a group; None if they only translate.

    Args:
        moves: layers of the moves, lowest first
        maps: linear maps of the parts of each move
        key: part and level of the weight in each move
        bands: number of SH coefficients above the first
    """
    axes = torch.eye(3, dtype=torch.float64)
    none = _Inverse.still(bands)
    matrix = axes
    shape = axes
    quat = none.quat[None]
    by_band = none.bands
    is_similar = True
    for k, layer in enumerate(moves):
        part = key[2 * k]
        if part < 0 or maps[k][part].is_identity:
            continue
        linear = maps[k][part]
        weight = key[2 * k + 1] / _WEIGHT_LEVELS
        geometry = weight * layer.gain("means")
        matrix = torch.lerp(axes, linear.matrix, geometry) @ matrix
        shape = torch.lerp(axes, linear.shape, geometry) @ shape
        quat = multiply_quats(torch.lerp(none.quat, linear.turn, geometry)[None], quat)
        by_band = torch.lerp(none.bands, linear.bands, weight * layer.gain("shN")) @ by_band
        is_similar &= linear.is_similar
    if torch.equal(shape, axes):
        return None
    back = quat[0] * torch.tensor([1.0, -1.0, -1.0, -1.0]) / quat.square().sum().clamp_min(1e-12)
    return _Inverse(
        torch.linalg.pinv(matrix, rtol=_FLAT),
        torch.linalg.pinv(shape),
        back,
        torch.linalg.pinv(by_band, rtol=_FLAT),
        is_similar,
    )
