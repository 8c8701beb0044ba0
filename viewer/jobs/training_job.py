"""Training runs as the panel shows them, pure: what was asked for, how far it is, what it says."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

Status = Literal["queued", "running", "stopping", "stopped", "elsewhere", "failed", "done"]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Seconds = Annotated[float, Meta(ge=0.0, le=1e9)]


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
    """How far a run is, as the trainer writes it to RUN/state/progress.json."""

    share: Share = 0.0  # of its whole time
    label: str = ""  # what it does, "" while it starts
    loss: str = ""  # of the training, "" where there is none
    seconds: Seconds = 0.0  # that were spent on it, in all its sessions


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


def duration(seconds: float) -> str:
    """ "12 s", "3 min", "1 h 20 min"."""
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
