"""The recorded trajectory of an edit: how every member moved, and at which slider value it was where.

Training leaves it in the run folder as trajectory.safetensors; `progdf fit` makes new fields of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.io.atomic import atomic_write, open_error
from progdf.io.json_values import convert_json, decode_json
from progdf.io.tensors import read_tensors, write_tensors

from .baked import MONOMIALS, find_segment

FILE_NAME = "trajectory.safetensors"
"""Its name in a run folder, beside the .gdf."""

_FORMAT = "progdf-trajectory-1"
_NEEDED_FORMS = (
    ("s", torch.float32, 1),
    ("offsets", torch.float16, 3),
    ("end", torch.float32, 2),
    ("steps", torch.int64, 1),
    ("stage_ends", torch.int64, 1),
    ("strengths", torch.float64, 1),
)
_NEEDED = {name for name, _, _ in _NEEDED_FORMS}


@dataclass(frozen=True)
class Trajectory:
    """S recordings of the members' offsets along the slider."""

    s: Tensor  # slider value of each recording, ascending, first 0, last 1. [S] float32
    # raw-space offsets; row 0 is zero, the last equals `end` in half precision. [S,M,C] float16
    offsets: Tensor
    end: Tensor  # the offset at s = 1, exact; the edited scene is original + end in float32. [M,C] float32
    steps: Tensor  # optimizer steps done at each recording. [S] int64
    stage_ends: tuple[int, ...]  # recording at which each stage ends, ascending, the last S − 1
    # what the editor was asked for, of each stage; `s[stage_ends]` is where that is
    strengths: tuple[float, ...]
    # of an edit of colors that is a map of the region and a residual of its members' lowest bands: the map of
    # each recording but the first [S-1,K,3], and how many bands that are
    maps: Tensor | None = None
    bands: int = 0
    mask: Tensor | None = None  # how much of the maps each member takes, see `GradeForm.mask`. [M] uint8
    added: Gaussians | None = None  # rows that the scene does not have, the last members, see `Gdf.added`

    def __len__(self) -> int:
        return int(self.s.shape[0])

    @property
    def stage_strengths(self) -> tuple[tuple[float, float], ...]:
        """Slider value of each stage's end, and the strength that the editor was asked for there."""
        return tuple((float(self.s[e]), s) for e, s in zip(self.stage_ends, self.strengths, strict=True))

    def at(self, s: float) -> Tensor:
        """Offsets at slider value `s`, linear between recordings, exact at both ends. [M,C] float32"""
        right, share = find_segment(self.s, s)
        return torch.lerp(self.node(right - 1), self.node(right), min(max(share, 0.0), 1.0))

    def node(self, index: int) -> Tensor:
        """Offsets of one recording. [M,C] float32"""
        return self.end if index == len(self) - 1 else self.offsets[index].float()


def save_trajectory(
    path: Path, trajectory: Trajectory, extra: Mapping[str, Tensor], about: Mapping[str, Any]
) -> None:
    """Write a trajectory with what a refit needs.

    Args:
        path: trajectory.safetensors
        trajectory: what to save
        extra: further tensors by name (members, score, cameras)
        about: JSON values (scene, options, …)
    """
    tensors = {
        "s": trajectory.s,
        "offsets": trajectory.offsets,
        "end": trajectory.end,
        "steps": trajectory.steps,
        "stage_ends": torch.tensor(trajectory.stage_ends),
        "strengths": torch.tensor(trajectory.strengths, dtype=torch.float64),
        **extra,
    }
    if trajectory.maps is not None:
        tensors |= {"maps": trajectory.maps, "bands": torch.tensor(trajectory.bands)}
    if trajectory.mask is not None:
        tensors["mask"] = trajectory.mask
    if trajectory.added is not None:
        tensors |= {f"added.{name}": getattr(trajectory.added, name) for name in ATTRIBUTES}
    header = {"format": _FORMAT, "about": json.dumps(dict(about))}
    with atomic_write(path) as temporary_file:
        write_tensors(temporary_file, tensors, header, checksum=True)


def load_trajectory(path: Path) -> tuple[Trajectory, dict[str, Tensor], dict[str, Any]]:
    """Read what `save_trajectory` wrote: trajectory, extra tensors, about.

    Raises:
        ProgdfError: the file is absent, damaged or something else.
    """
    tensors, about = _read(path)
    for name, dtype, sides in _NEEDED_FORMS:
        tensor = tensors[name]
        if tensor.dtype != dtype or tensor.ndim != sides:
            raise _damage_error(path, f"{name} is {list(tensor.shape)} {tensor.dtype}")
    added = {name: tensors.pop(f"added.{name}") for name in ATTRIBUTES if f"added.{name}" in tensors}
    trajectory = Trajectory(
        tensors.pop("s"),
        tensors.pop("offsets"),
        tensors.pop("end"),
        tensors.pop("steps"),
        tuple(tensors.pop("stage_ends").tolist()),
        tuple(tensors.pop("strengths").tolist()),
        maps=tensors.pop("maps", None),
        bands=int(tensors.pop("bands", torch.tensor(0))),
        mask=tensors.pop("mask", None),
        added=_unpack_added(path, added) if added else None,
    )
    _check(path, trajectory)
    return trajectory, tensors, about


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors, and the file's metadata."""
    try:
        tensors, header = read_tensors(path)
        if header.get("format") != _FORMAT:
            raise ProgdfError(f"{path} is not a recorded trajectory; give a run folder of progdf train")
        if missing := _NEEDED - set(tensors):
            raise _damage_error(path, f"it has no {min(missing)}")
        return tensors, convert_json(decode_json(header["about"]), dict[str, Any])
    except OSError as error:
        raise open_error(path, error) from error
    except ProgdfError:
        raise
    except (KeyError, ValueError) as error:
        raise _damage_error(path, error) from error


def _unpack_added(path: Path, rows: Mapping[str, Any]) -> Gaussians:
    try:
        added = Gaussians(**rows)
    except (TypeError, ValueError) as error:
        raise _damage_error(path, error) from error
    if not all(part.dtype == torch.float32 and bool(part.isfinite().all()) for part in rows.values()):
        raise _damage_error(path, "an added row has numbers that are none")
    return added


def _check(path: Path, trajectory: Trajectory) -> None:
    s, shape = trajectory.s, trajectory.offsets.shape
    fits = s.ndim == 1 and len(s) >= 2 and len(shape) == 3 and len(s) == shape[0]
    if not fits or trajectory.end.shape != shape[1:]:
        raise _damage_error(path, "its tensors do not fit each other")
    if float(s[0]) != 0.0 or float(s[-1]) != 1.0 or not bool((s.diff() > 0).all()):
        raise _damage_error(path, "its slider values do not ascend from 0 to 1")
    ends = trajectory.stage_ends
    ascend = all(before < after for before, after in pairwise((0, *ends)))
    if not ends or len(ends) != len(trajectory.strengths) or not ascend or ends[-1] != len(s) - 1:
        raise _damage_error(path, "its stages do not fit its recordings")
    maps = trajectory.maps
    if maps is not None and (
        maps.dtype != torch.float32
        or maps.shape[1:] not in [(count, 3) for count in MONOMIALS.values()]
        or len(maps) != len(s) - 1
        or not bool(maps.isfinite().all())
        or trajectory.bands not in (0, 1, 4)
    ):
        raise _damage_error(path, "its maps of color do not fit its recordings")
    mask = trajectory.mask
    if mask is not None and (mask.dtype != torch.uint8 or mask.shape != shape[1:2]):
        raise _damage_error(path, "its mask does not fit its members")
    if len(trajectory.steps) != len(s) or not bool(
        trajectory.offsets.isfinite().all() & trajectory.end.isfinite().all()
    ):
        raise _damage_error(path, "it has numbers that are not finite, or not one step a recording")


def _damage_error(path: Path, reason: object) -> ProgdfError:
    return ProgdfError(f"{path} is damaged ({reason}); train again")
