"""What a run writes beside its recording: all that is known of it once it is made, typed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trainer.editors.base import EditKind
from trainer.option_checks import check_name
from trainer.plan import Plan


@dataclass(frozen=True)
class RunRecord:
    """What the recording's file tells of the run.

    Args:
        plan: what was to be done
        scene: where the scene was
        held_out: names of the views that the edit was not trained on
        background: color behind the scene
        kind: what the edit moves
        group_steps: of the stage in which parts move as wholes; 0: there was none
        kind_trial: figures of the trial that found these two, if there was one
        objective: what was minimized, in words
        losses: see `Losses`
        attribute_worth_db: what the edit would lose without each attribute, dB
        agreement: whether the edited views agree, where that was measured
        followed: members that took their colors from others
        up: the axis that is up, and why
        pictures: changed pictures that it was trained on, and their hashes

    Raises:
        ValueError: the losses do not fit each other, or the name is none.
    """

    plan: Plan
    scene: Path
    held_out: Sequence[str]
    background: tuple[float, float, float]
    kind: EditKind
    group_steps: int
    kind_trial: Mapping[str, Any] | None
    objective: str
    losses: Mapping[str, Sequence[float | None]]
    attribute_worth_db: Mapping[str, float]
    agreement: Mapping[str, Any] | None
    followed: int
    up: Mapping[str, Any] | None
    pictures: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        columns = [self.losses.get(name, []) for name in ("step", "left")]
        if not all(columns) or len({len(column) for column in self.losses.values()}) > 1:
            raise ValueError("its losses do not fit each other")
        check_name(self.plan.name)
