"""A region in few bytes: rows as bits, runs or numbers; the score as 8 bits where it is soft."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from progdf.region import Region


def pack_region(region: Region) -> dict[str, Tensor]:
    """Tensors for a .gdf file.

    The score is kept to 1/255, and only where that differs from 1 for members and 0 for all others.
    """
    members = region.members.cpu().numpy()
    count = len(region.score)
    levels = (region.score.cpu().float().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    crisp = np.zeros(count, np.uint8)
    crisp[members] = 255
    soft = np.flatnonzero(levels != crisp)
    tensors = _pack_rows("members", members, count)
    if len(soft):
        tensors |= _pack_rows("score", soft, count)
        tensors["score.levels"] = torch.from_numpy(levels[soft])
    return tensors


def unpack_region(
    name: str, tensors: Mapping[str, Tensor], count: int, expected: int | None = None
) -> Region:
    """The inverse of `pack_region` for a scene of `count` Gaussians; with how many members, if it is known.

    Raises:
        ValueError, KeyError: the tensors do not describe rows of that scene.
    """
    members = _unpack_rows("members", tensors, count, expected)
    score = torch.zeros(count)
    score[members] = 1.0
    if "score.levels" in tensors:
        levels = tensors["score.levels"]
        soft = _unpack_rows("score", tensors, count, levels.numel())
        if levels.dtype != torch.uint8 or levels.shape != soft.shape:
            raise ValueError(f"{len(soft)} soft scores have levels {list(levels.shape)} {levels.dtype}")
        score[soft] = levels.float() / 255
    return Region(name, members, score)


def _pack_rows(key: str, rows: np.ndarray, count: int) -> dict[str, Tensor]:
    """Sorted unique rows below `count`: `.bits` [⌈N/8⌉], `.runs` [R,2] first and length, or `.rows` [M]."""
    breaks = np.flatnonzero(np.diff(rows) != 1) + 1
    starts = np.concatenate([rows[:1], rows[breaks]])
    ends = np.concatenate([rows[breaks - 1], rows[-1:]])
    sizes = {"runs": 8 * len(starts), "rows": 4 * len(rows), "bits": (count + 7) // 8}
    stored: np.ndarray
    shortest = min(sizes, key=lambda form: sizes[form])
    if shortest == "runs":
        stored = np.stack([starts, ends - starts + 1], axis=1).astype(np.int32)
    elif shortest == "rows":
        stored = rows.astype(np.int32)
    else:
        mask = np.zeros(count, np.bool_)
        mask[rows] = True
        stored = np.packbits(mask)
    return {f"{key}.{shortest}": torch.from_numpy(stored)}


def _unpack_rows(key: str, tensors: Mapping[str, Tensor], count: int, expected: int | None) -> Tensor:
    """Sorted, unique and within the scene, or a ValueError; as many as expected, checked beforehand,
    as eight bytes of a run can name millions. [M] int64"""
    if f"{key}.bits" in tensors:
        bits = tensors[f"{key}.bits"]
        if bits.dtype != torch.uint8 or list(bits.shape) != [(count + 7) // 8]:
            raise ValueError(f"{key}.bits is {list(bits.shape)} {bits.dtype} for {count} Gaussians")
        mask = np.unpackbits(bits.numpy())
        if mask[count:].any():
            raise ValueError(f"{key}.bits names rows beyond {count}")
        return torch.from_numpy(np.flatnonzero(mask[:count]).astype(np.int64))
    if f"{key}.runs" in tensors:
        runs = tensors[f"{key}.runs"]
        if runs.dtype != torch.int32 or runs.ndim != 2 or runs.shape[1] != 2:
            raise ValueError(f"{key}.runs is {list(runs.shape)} {runs.dtype}")
        starts, lengths = runs.numpy().astype(np.int64).T
        ends = starts + lengths
        if len(runs) and (
            (lengths < 1).any() or starts[0] < 0 or ends[-1] > count or (starts[1:] < ends[:-1]).any()
        ):
            raise ValueError(f"{key}.runs leave the scene or overlap")
        if expected is not None and int(lengths.sum()) != expected:
            raise ValueError(f"{key}.runs name {int(lengths.sum())} rows of {expected}")
        before = np.repeat(np.cumsum(lengths) - lengths, lengths)
        return torch.from_numpy(np.repeat(starts, lengths) + np.arange(int(lengths.sum())) - before)
    rows = tensors[f"{key}.rows"]
    if rows.dtype != torch.int32 or rows.ndim != 1:
        raise ValueError(f"{key}.rows is {list(rows.shape)} {rows.dtype}")
    found = rows.numpy().astype(np.int64)
    if len(found) and (found[0] < 0 or found[-1] >= count or (np.diff(found) <= 0).any()):
        raise ValueError(f"{key}.rows are not sorted rows of the scene")
    return torch.from_numpy(found)
