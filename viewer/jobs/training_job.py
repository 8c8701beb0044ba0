"""Training runs as the panel shows them, pure: what was asked for, how far it is, what it says."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Status = Literal["queued", "running", "stopping", "stopped", "elsewhere", "failed", "done"]

PHASES = (
    ("edit", 0.08, 0.38),
    ("even the slider", 0.08, 0.2),
    ("try kinds", 0.08, 0.2),
    ("move parts", 0.38, 0.5),
    ("optimize", 0.38, 0.64),
    ("time the slider", 0.64, 0.66),
    ("picture the edit", 0.66, 0.7),
    ("weigh the members", 0.7, 0.73),
    ("fit the field", 0.73, 0.82),
    ("field", 0.7, 0.82),
    ("measure the edit", 0.82, 0.96),
)
"""What `progdf train` says that it does, and between which shares of its time that usually lies."""

SAID = {
    "": "Starting",
    "edit": "Editing views",
    "even the slider": "Evening the slider",
    "try kinds": "Choosing what moves",
    "move parts": "Moving parts",
    "optimize": "Training",
    "time the slider": "Timing the slider",
    "picture the edit": "Finishing",
    "weigh the members": "Packing",
    "fit the field": "Packing",
    "field": "Packing",
    "measure the edit": "Measuring",
}


@dataclass(frozen=True)
class EditOrder:
    """What shall be trained.

    Args:
        scene: its file
        out: the run's folder
        name: of the layer
        region: as `progdf train --region` has it
        editor: as `progdf train --editor` has it
        quick: a draft
        threads: CPU threads; 0 takes all
    """

    scene: Path
    out: Path
    name: str
    region: str
    editor: str
    quick: bool = True
    threads: int = 0

    def arguments(self, resume: bool = False) -> list[str]:
        """Words after `progdf`."""
        words = ["train", str(self.scene), f"--out={self.out}", f"--region={self.region}"]
        words += [f"--editor={self.editor}", f"--name={self.name}", f"--threads={self.threads}"]
        return words + ["--quick"] * self.quick + ["--resume"] * resume

    @property
    def gdf(self) -> Path:
        """The edit, once it is trained."""
        return self.out / f"{self.name}.gdf"


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Args:
        share: of its whole time, 0..1, by what its part usually takes
        doing: in the words of the trainer
        loss: of the training, "" while there is none
        seconds: that were spent on it, in all its sessions
    """

    share: float = 0.0
    doing: str = ""
    loss: str = ""
    seconds: float = 0.0

    @property
    def said(self) -> str:
        """What the run does, for the person."""
        return SAID.get(self.doing, self.doing.capitalize())


@dataclass(frozen=True)
class TrainingJob:
    """A run in the queue.

    Args:
        number: what it is called by
        order: what is trained
        status: where it stands; "elsewhere" is in another window or process
        progress: how far it is
        seconds: that it has run, in this session of it
        error: the one line of a failure
        warning: the one line of a run that came out poor
        resumes: whether it goes on with what was stopped
        began_at: share that was done when this session of it began
        starved: other programs keep the processor
        elsewhere: the name of its scene where another one is open, else ""
    """

    number: int
    order: EditOrder
    status: Status = "queued"
    progress: Progress = field(default_factory=Progress)
    seconds: float = 0.0
    error: str = ""
    warning: str = ""
    resumes: bool = False
    began_at: float = 0.0
    starved: bool = False
    elsewhere: str = ""

    @property
    def seconds_left(self) -> float | None:
        """By how long the rest should take at this pace; None before anything is known."""
        done = self.progress.share - self.began_at
        if self.status != "running" or done < 0.05 or self.seconds < 2.0:
            return None
        return self.seconds * (1.0 - self.progress.share) / done


def progress_of(
    doing: str, done: int, total: int, note: str, before: Progress, seconds: float = 0.0
) -> Progress:
    """Progress by what the trainer says; the share never goes back."""
    low, high = next(((low, high) for name, low, high in PHASES if name == doing), (before.share,) * 2)
    share = low + (high - low) * min(max(done / max(total, 1), 0.0), 1.0)
    loss = re.search(r"loss\D*([\d.]+)", note)
    spent = max(seconds, before.seconds)  # a run that goes on begins at 0 again, until it has its state
    return Progress(max(share, before.share), doing, loss[1].rstrip(".") if loss else before.loss, spent)


def duration(seconds: float) -> str:
    """ "12 s", "3 min", "1 h 20 min"."""
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
