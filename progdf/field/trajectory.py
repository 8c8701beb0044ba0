"""Recorded trajectory of an edit: the offsets of every member, and the slider value of each recording.

Training writes it to the run folder as trajectory.safetensors. `progdf fit` makes new fields from it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.io.atomic import atomic_write, open_error
from progdf.io.json_values import convert_json, decode_json
from progdf.io.tensors import check_ascent, check_tensor, read_tensors, write_tensors
from progdf.system.equality import equal_fields

from .baked import MONOMIALS, find_segment, identity_map, member_ranges

FILE_NAME = "trajectory.safetensors"
"""File name in a run folder, beside the .gdf."""

_FORMAT = "progdf-trajectory-1"


@dataclass(frozen=True)
class Trajectory:
    """S recordings of the members' offsets along the slider."""

    __eq__ = equal_fields

    s: Tensor  # slider value of each recording, ascending, first 0, last 1. [S] float32
    # raw-space offsets; row 0 is zero, the last is `end` in half precision. [S,M,C] float16
    offsets: Tensor
    end: Tensor  # the offset at s = 1, exact; the edited scene is original + end in float32. [M,C] float32
    steps: Tensor  # optimizer steps at each recording. [S] int64
    stage_ends: tuple[int, ...]  # index of the recording at each stage's end, ascending, the last S − 1
    # strength requested from the editor for each stage; its slider value is `s[stage_ends]`
    strengths: tuple[float, ...]
    # for an edit of colors by a map of the region and a residual of the lowest bands: the map of each
    # recording but the first [S-1,K,3], and the number of SH functions of the residual: 0, 1, 4 or 9
    maps: Tensor | None = None
    bands: int = 0
    mask: Tensor | None = None  # share of the maps per member, see `GradeForm.mask`. [M] uint8
    added: Gaussians | None = None  # rows that the scene does not contain, the last members, see `Gdf.added`

    def __len__(self) -> int:
        return int(self.s.shape[0])

    def take(self, members: Tensor) -> Trajectory:
        """Return the recordings of some members of an edit without added rows. [m] int64"""
        mask = None if self.mask is None else self.mask[members]
        return replace(self, offsets=self.offsets[:, members], end=self.end[members], mask=mask)

    @property
    def stage_strengths(self) -> tuple[tuple[float, float], ...]:
        """Slider value of each stage's end, and the strength requested from the editor there."""
        return tuple((float(self.s[e]), s) for e, s in zip(self.stage_ends, self.strengths, strict=True))

    def at(self, s: float) -> Tensor:
        """Return offsets at slider value `s`, linear between recordings, exact at both ends. [M,C] float32"""
        right, share = find_segment(self.s, s)
        before = self.offsets[right - 1]
        after = self.end if right == len(self) - 1 else self.offsets[right]
        share = min(max(share, 0.0), 1.0)
        total = torch.empty(self.end.shape)
        for part in member_ranges(len(total)):
            torch.lerp(before[part].float(), after[part].float(), share, out=total[part])
        return total

    @property
    def map_course(self) -> tuple[int, Tensor]:
        """Degree of the maps, and the map of each recording; that of the original is the identity. [S,K,3]"""
        assert self.maps is not None
        degree = next(d for d, count in MONOMIALS.items() if count == self.maps.shape[1])
        return degree, torch.cat([identity_map(degree)[None], self.maps])

    def node(self, index: int) -> Tensor:
        """Return the offsets of one recording. [M,C] float32"""
        return self.end if index == len(self) - 1 else self.offsets[index].float()

    @property
    def nodes(self) -> Tensor:
        """Offsets of all recordings. [S,M,C] float32"""
        return torch.stack([self.node(i) for i in range(len(self))])


def save_trajectory(
    path: Path, trajectory: Trajectory, extra: Mapping[str, Tensor], about: Mapping[str, Any]
) -> None:
    """Write a trajectory with the data that a refit needs.

    Args:
        path: trajectory.safetensors
        trajectory: the trajectory to save
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
        write_tensors(temporary_file, tensors, header)


def load_trajectory(path: Path) -> tuple[Trajectory, dict[str, Tensor], dict[str, Any]]:
    """Read a file of `save_trajectory`; return the trajectory, the extra tensors and `about`.

    Raises:
        ProgdfError: the file is absent, damaged or not a trajectory file.
    """
    try:
        tensors, header = read_tensors(path)
        if header.get("format") != _FORMAT:
            raise ProgdfError(f"{path} is not a recorded trajectory; give a run folder of progdf train")
        about = convert_json(decode_json(header["about"]), dict[str, Any])
        return _unpack(tensors), tensors, about
    except OSError as error:
        raise open_error(path, error) from error
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = f"it has no {error.args[0]}" if isinstance(error, KeyError) else error
        raise ProgdfError(f"{path} is damaged ({reason}); train again") from error


def _unpack(tensors: dict[str, Tensor]) -> Trajectory:
    """Remove the trajectory's tensors from `tensors` and return the trajectory.

    Raises:
        KeyError, ValueError: a tensor is absent or does not fit.
    """
    added: dict[str, Any] = {
        name: tensors.pop(f"added.{name}") for name in ATTRIBUTES if f"added.{name}" in tensors
    }
    s, offsets, end, steps = (tensors.pop(name) for name in ("s", "offsets", "end", "steps"))
    ends = tensors.pop("stage_ends")
    strengths = tensors.pop("strengths")
    maps = tensors.pop("maps", None)
    mask = tensors.pop("mask", None)
    bands = int(tensors.pop("bands", torch.tensor(0)))
    check_tensor("s", s, (None,), torch.float32)
    check_ascent("s", s)
    check_tensor("offsets", offsets, (len(s), None, None), torch.float16)
    check_tensor("end", end, offsets.shape[1:], torch.float32)
    check_tensor("steps", steps, s.shape, torch.int64)
    check_tensor("stage_ends", ends, (None,), torch.int64)
    check_tensor("strengths", strengths, ends.shape, torch.float64)
    if not len(ends) or bool((ends.diff(prepend=ends.new_zeros(1)) <= 0).any()) or ends[-1] != len(s) - 1:
        raise ValueError("its stages do not fit its recordings")
    if maps is not None:
        check_tensor("maps", maps, (len(s) - 1, None, 3), torch.float32)
        if maps.shape[1] not in MONOMIALS.values() or bands not in (0, 1, 4, 9):
            raise ValueError(f"unexpected map of {maps.shape[1]} numbers or residual of {bands} bands")
    if mask is not None:
        check_tensor("mask", mask, offsets.shape[1:2], torch.uint8)
    for name, part in added.items():
        check_tensor(name, part, part.shape, torch.float32)
    numbers = [offsets, end, *added.values()]
    if maps is not None:
        numbers.append(maps)
    if not all(bool(part.isfinite().all()) for part in numbers):
        raise ValueError("it has numbers that are not finite")
    stages = tuple(ends.tolist()), tuple(strengths.tolist())
    return Trajectory(
        s, offsets, end, steps, *stages, maps, bands, mask, added=Gaussians(**added) if added else None
    )
