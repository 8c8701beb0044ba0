"""Value noise in 3D: smooth random numbers that are a function of place, so textures have no seams."""

from __future__ import annotations

import torch
from torch import Tensor

_SIDE = 64  # the lattice repeats after this many cells; a power of two


def lattice(seed: int) -> Tensor:
    """Random numbers in −1..1 on a lattice of 64³ nodes, for `noise`. [64³] float32"""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(_SIDE**3, generator=generator) * 2 - 1


def noise(points: Tensor, table: Tensor, frequency: float, octaves: int = 1) -> Tensor:
    """Value noise, −1..1, mean about 0; each octave doubles the frequency and halves the height.

    Args:
        points: where. [N,3]
        table: what `lattice` made
        frequency: cells per world unit
        octaves: how many layers of detail, ≥ 1

    Returns:
        [N]
    """
    total = torch.zeros(points.shape[0])
    height, span = 1.0, 0.0
    for octave in range(octaves):
        # the shift keeps the lattice planes of the octaves, and the part's planes of symmetry, apart
        total += height * _value_noise(points * frequency + 17.31 * (octave + 1), table)
        span += height
        height, frequency = height / 2, frequency * 2
    return total / span


def _value_noise(places: Tensor, table: Tensor) -> Tensor:
    cell = places.floor()
    f = places - cell
    f = f * f * (3 - 2 * f)
    low = cell.long() & (_SIDE - 1)
    high = (low + 1) & (_SIDE - 1)
    x = (low[:, 0] * _SIDE * _SIDE, high[:, 0] * _SIDE * _SIDE)
    y = (low[:, 1] * _SIDE, high[:, 1] * _SIDE)
    z = (low[:, 2], high[:, 2])
    planes = []
    for i in range(2):
        rows = [torch.lerp(table[x[i] + y[j] + z[0]], table[x[i] + y[j] + z[1]], f[:, 2]) for j in range(2)]
        planes.append(torch.lerp(rows[0], rows[1], f[:, 1]))
    return torch.lerp(planes[0], planes[1], f[:, 0])
