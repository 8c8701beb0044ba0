"""The state of the optimization between two steps: the members' offsets, Adam's memory, what was measured.

Everything that decides the steps to come is here, and nothing that can be computed again from the run's
inputs. So a run that is stopped between two steps goes on from `PgsState.capture_state` to the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import torch
from torch import Tensor

from progdf.gaussians import attribute_slices
from progdf.io.json_values import convert_json
from trainer.store.state import Saved, generator

from .objective import TermMeans

EPSILON = 0.1
"""Of the root mean square of an attribute's gradient: Adam's ε where it is raised."""

_ROWS = ("moved", "previous", "average", "first", "second")


class _StateValues(msgspec.Struct):
    """What `PgsState.capture_state` gives beside tensors."""

    step: int
    stage: int
    local: int
    recorded: int
    running: float | None
    means: dict[str, tuple[float, int]]
    queue: list[int]


class PgsState:
    """The state of one optimization, changed in place by its steps.

    Args:
        rows: the members' packed raw rows; the state starts exactly at these. [M,C]
        seed: order of the views

    Attributes:
        moved: offsets of the members, a leaf that takes gradients. [M,C]
        previous: the offsets one step earlier. [M,C]
        average: their running mean, which is what is recorded. [M,C]
        first, second: Adam's moments. [M,C]
        pictures: the probes at the last recording. [h,w,3] each; empty before the first step
        step: steps done
        stage, local: index of the stage, and steps done in it
        recorded: how many recordings were made
        running: running mean of the L1 distance from the finished edit; NaN before the first step
        means: loss terms since the last recording
    """

    def __init__(self, rows: Tensor, seed: int = 0) -> None:
        self.moved = torch.zeros_like(rows, requires_grad=True)
        self.previous = torch.zeros_like(rows)
        self.average = torch.zeros_like(rows)
        self.first, self.second = torch.zeros_like(rows), torch.zeros_like(rows)
        self.pictures: Sequence[Tensor] = ()
        self.step = self.stage = self.local = self.recorded = 0
        self.running = math.nan
        self.means = TermMeans()
        self._order = torch.Generator().manual_seed(seed)
        self._queue: list[int] = []

    def view(self, count: int) -> int:
        """Index of the view whose turn it is: all of them in random order, again and again."""
        if not self._queue:
            self._queue = torch.randperm(count, generator=self._order).tolist()
        return self._queue[-1]

    def descend(
        self,
        gradient: Tensor,
        rates: Tensor,
        length: float,
        raised: bool,
        smoothing: float,
        growth: float = math.inf,
    ) -> None:
        """One step of Adam (Kingma and Ba 2015), with a rate per column; the next view is due.

        Adam does not know how large a gradient is, so a member that hardly shows would wander as far as one
        in plain sight. A tenth of the attribute's typical gradient, added to ε, keeps it still.
        (docs/experiments.md, Rates and steps).

        Args:
            gradient: of the loss in `moved`. [M,C]
            rates: learning rate of each column. [C]
            length: factor to them all
            raised: see above; False is Adam as printed
            smoothing: share that the running mean keeps of itself; it starts exactly at the original
            growth: how many times as large as it was a member may become
        """
        done = self.step + 1
        self.first.lerp_(gradient, 0.1)
        self.second.lerp_(gradient.square(), 0.001)
        mean = self.first / (1 - 0.9**done)
        spread = (self.second / (1 - 0.999**done)).sqrt()
        floor = torch.full_like(rates, 1e-15)
        if raised:
            for columns in attribute_slices(len(rates)).values():
                floor[columns] += EPSILON * spread[:, columns].square().mean().sqrt()
        with torch.no_grad():
            self.previous.copy_(self.moved)
            self.moved -= length * (rates * mean / (spread + floor))
            if growth < math.inf:
                self.moved[:, attribute_slices(len(rates))["log_scales"]].clamp_(max=math.log(growth))
        self.average.lerp_(self.moved.detach(), 1.0 - min(smoothing, (self.step + 1) / (self.step + 10)))
        self.step, self.local = done, self.local + 1
        self._queue.pop()

    def capture_state(self) -> Saved:
        """See `state.Resumable`."""
        tensors = {name: getattr(self, name) for name in _ROWS}
        tensors |= {f"picture{i}": picture for i, picture in enumerate(self.pictures)}
        tensors["order"] = self._order.get_state()
        values = {
            "step": self.step,
            "stage": self.stage,
            "local": self.local,
            "recorded": self.recorded,
            "running": self.running if self.step else None,
            "means": {name: list(sums) for name, sums in self.means.sums.items()},
            "queue": self._queue,
        }
        return Saved(tensors, values)

    def restore(self, saved: Saved) -> None:
        """See `state.Resumable`."""
        tensors, values = saved.tensors, convert_json(saved.values, _StateValues)
        with torch.no_grad():
            for name in _ROWS:
                getattr(self, name).copy_(tensors[name])
        self.pictures = [tensors[f"picture{i}"] for i in range(sum(k.startswith("picture") for k in tensors))]
        self.step, self.stage, self.local = values.step, values.stage, values.local
        self.recorded = values.recorded
        self.running = math.nan if values.running is None else values.running
        self.means.sums = dict(values.means)
        self._order, self._queue = generator(tensors["order"]), list(values.queue)
