"""The recordings of an optimization, each written once to a file of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.json_values import convert_json
from trainer.optimize.pgs import ParameterSnapshot
from trainer.store.state import Saved, StateFolder


class _RecordingValues(msgspec.Struct):
    """What is saved of a recording beside its offsets."""

    step: int
    stage: int
    ends_stage: bool
    means: dict[str, float]


@dataclass(frozen=True)
class SavedSnapshot:
    """A snapshot as it is kept.

    Args:
        step, stage, ends_stage, means: see `ParameterSnapshot`
        offsets: of the members, in half precision. [M,C] float16
    """

    step: int
    stage: int
    ends_stage: bool
    offsets: Tensor
    means: Mapping[str, float]


class Recordings:
    """All recordings so far, a `state.Resumable`: each is written once, to a file of its own.

    Args:
        folder: where
        shape: of the offsets
    """

    def __init__(self, folder: StateFolder, shape: torch.Size) -> None:
        self.made: list[SavedSnapshot] = []
        self._folder, self._shape, self._written = folder, shape, 0

    def add(self, found: ParameterSnapshot) -> None:
        """Keep one."""
        offsets = found.offsets.half()
        self.made.append(SavedSnapshot(found.step, found.stage, found.ends_stage, offsets, found.means))

    def capture_state(self) -> Saved:
        """How many there are; those that came since the last time are written first."""
        for index in range(self._written, len(self.made)):
            kept = self.made[index]
            values = {"step": kept.step, "stage": kept.stage, "ends_stage": kept.ends_stage}
            self._folder.save("recordings", {"offsets": kept.offsets}, values | {"means": kept.means}, index)
        self._written = len(self.made)
        return Saved({}, {"count": self._written})

    def restore(self, saved: Saved) -> None:
        """Read as many as there were; what a killed run wrote beyond them will be written again."""
        self._written = saved.values["count"]
        found = [self._folder.load("recordings", index) for index in range(self._written)]
        if None in found:
            raise ProgdfError(f"recordings are missing in {self._folder.path}; delete it and train again")
        self.made = [self._read(kept) for kept in found if kept]

    def _read(self, kept: Saved) -> SavedSnapshot:
        values, offsets = convert_json(kept.values, _RecordingValues), kept.tensors["offsets"]
        if offsets.shape != self._shape or offsets.dtype != torch.float16:
            raise ValueError("a recording is of other members")
        return SavedSnapshot(values.step, values.stage, values.ends_stage, offsets, values.means)
