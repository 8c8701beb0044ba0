"""Scene as raw (pre-activation) Gaussian parameters, with the meaning of the 3DGS .ply file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.quaternions import normalize_quats
from progdf.system.equality import equal_fields

ATTRIBUTES = ("means", "log_scales", "quats", "logit_opacities", "sh0", "shN")
"""Attribute names in the order in which offsets are packed; see `attribute_slices`."""

_WIDTHS = {"means": 3, "log_scales": 3, "quats": 4, "logit_opacities": 1, "sh0": 3}
BASE_CHANNELS = sum(_WIDTHS.values())
"""Channels of a packed row without higher SH bands: 3 + 3 + 4 + 1 + 3 = 14."""

_SH_BANDS = {0: 0, 3: 1, 8: 2, 15: 3, 24: 4}

Origin = tuple[float, float, float]
"""Point of the world in float64; float32 coordinates are relative to it."""

ZERO: Origin = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as raw tensors; activate with `scales`, `opacities`, `unit_quats`.

    Raises:
        ValueError: a shape does not fit the others.
    """

    __eq__ = equal_fields

    means: Tensor  # centers relative to `origin`, world units. [N,3]
    quats: Tensor  # rotations wxyz, any nonzero length. [N,4]
    log_scales: Tensor  # log of the standard deviations in world units. [N,3]
    logit_opacities: Tensor  # opacities before the sigmoid. [N]
    sh0: Tensor  # color, band 0 of the spherical harmonics. [N,3]
    shN: Tensor  # color, bands 1 to d. [N,K,3] with K = (d+1)² − 1, so 0, 3, 8, 15 or 24
    # trained and drawn with Mip-Splatting's 2D filter, see `rasterize`
    antialiased: bool = False
    # world position of the origin of the means, see `progdf.formats.repair.find_origin`. Coordinates inside
    # the program, including cameras, are relative to it. Files, options and messages use world coordinates
    origin: Origin = ZERO

    def __post_init__(self) -> None:
        n = self.means.shape[0] if self.means.ndim else 0
        for name, width in _WIDTHS.items():
            actual = tuple(getattr(self, name).shape)
            shape = (n,) if name == "logit_opacities" else (n, width)
            if actual != shape:
                raise ValueError(
                    f"{name} has shape {list(actual)}, expected {list(shape)} (N={n} from means)"
                )
        actual = tuple(self.shN.shape)
        if len(actual) != 3 or actual[0] != n or actual[2] != 3 or actual[1] not in _SH_BANDS:
            raise ValueError(
                f"shN has shape {list(actual)}, expected [{n}, K, 3] with K one of {list(_SH_BANDS)}"
            )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        """Return the selected rows. `index`: int64 indices [M], a bool mask [N] or a slice."""
        return replace(self, **{name: getattr(self, name)[index] for name in ATTRIBUTES})

    @property
    def world_means(self) -> Tensor:
        """Centers in world coordinates. [N,3] float64"""
        return self.means.detach().double() + torch.tensor(self.origin, dtype=torch.float64)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return _SH_BANDS[int(self.shN.shape[1])]

    @property
    def scales(self) -> Tensor:
        """Standard deviations in world units. [N,3]"""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Tensor:
        """Opacities, 0 to 1. [N]"""
        return self.logit_opacities.sigmoid()

    @property
    def unit_quats(self) -> Tensor:
        """Rotations as unit quaternions wxyz; a zero quaternion is the identity. [N,4]"""
        return normalize_quats(self.quats)

    @property
    def sh(self) -> Tensor:
        """All SH coefficients, band 0 first. [N,K+1,3]"""
        return torch.cat([self.sh0[:, None], self.shN], dim=1)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Gaussians:
        """Return the Gaussians on another device or with another floating-point type."""
        return replace(
            self, **{name: getattr(self, name).to(device=device, dtype=dtype) for name in ATTRIBUTES}
        )

    def replace_rows(self, rows: Tensor, packed: Tensor) -> Gaussians:
        """Return a copy with the given rows set from packed values; every other row keeps its bytes.

        Args:
            rows: row indices, unique. [M] int64
            packed: new raw values in the form of `pack`; with C = 14, shN is unchanged. [M,C]
        """
        changed: dict[str, Any] = {}
        for name, channels in attribute_slices(packed.shape[1]).items():
            old: Tensor = getattr(self, name)
            new = packed[:, channels].reshape(-1, *old.shape[1:])
            changed[name] = old.index_copy(0, rows, new.to(old.dtype))
        return replace(self, **changed)


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenate the rows of parts with equal SH degree; origin and `antialiased` are those of the first."""
    joined: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts]) for name in ATTRIBUTES}
    return replace(parts[0], **joined)


def from_arrays(arrays: Mapping[str, NDArray[np.floating]], antialiased: bool = False) -> Gaussians:
    """Return Gaussians from numpy arrays by attribute name; the dtypes are unchanged."""
    tensors: dict[str, Any] = {n: torch.from_numpy(np.ascontiguousarray(a)) for n, a in arrays.items()}
    return Gaussians(**tensors, antialiased=antialiased)


def attribute_slices(channels: int) -> dict[str, slice]:
    """Return the slice of each attribute in a packed row of `channels` numbers (14, or 14 + 3K with shN).

    Order: means 3, log_scales 3, quats 4, logit_opacities 1, sh0 3, then shN as K·3, rgb innermost.
    """
    if channels < BASE_CHANNELS or (channels - BASE_CHANNELS) % 3:
        raise ValueError(f"a packed row has {channels} channels, expected 14 or 14 + 3K")
    slices: dict[str, slice] = {}
    start = 0
    for name, width in _WIDTHS.items():
        slices[name] = slice(start, start + width)
        start += width
    if channels > BASE_CHANNELS:
        slices["shN"] = slice(start, channels)
    return slices


def pack(gaussians: Gaussians, with_shN: bool = False) -> Tensor:
    """Return the raw parameters in one tensor, in the order of `attribute_slices`. [N,14] or [N,14+3K]"""
    parts = [getattr(gaussians, name) for name in (ATTRIBUTES if with_shN else _WIDTHS)]
    return torch.cat([part.flatten(1) if part.ndim > 1 else part[:, None] for part in parts], dim=1)


def unpack(packed: Tensor, shN: Tensor) -> Gaussians:
    """Invert `pack`; `shN` [N,K,3] is used if the packed rows hold no higher bands."""
    parts: dict[str, Any] = {
        name: packed[:, channels] for name, channels in attribute_slices(packed.shape[1]).items()
    }
    parts["logit_opacities"] = parts["logit_opacities"][:, 0]
    higher = parts.pop("shN", None)
    return Gaussians(**parts, shN=shN if higher is None else higher.reshape(len(packed), -1, 3))
