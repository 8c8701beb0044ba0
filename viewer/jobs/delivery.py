"""What the window delivers by child processes: an exported scene, a picture, a film."""

from __future__ import annotations

import re
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from .child import Progress, last_line

FORMATS = (".mp4", ".gif", "")
"""Of films: two kinds of files, and a folder of frames."""
FORMAT_NAMES = ("MP4", "GIF", "PNG frames")
SIZES = ((1280, 720), (1920, 1080), (2560, 1440), (3840, 2160))
FPS = (12, 24, 25, 30, 60)


@dataclass(frozen=True)
class DeliverOptions:
    """What a picture or a film is asked for."""

    width: int = 1920  # pixels
    height: int = 1080
    alpha: bool = False  # the background is transparent
    fps: int = 24  # frames a second
    seconds: float = 4.0  # of a film that moves a slider there and back
    format: str = ".mp4"  # of `FORMATS`
    moves: str = ""  # "timeline", or the name of the layer whose slider moves
    can_move: tuple[str, ...] = ()  # what there is to choose from


@dataclass(frozen=True)
class Delivery:
    """A command that writes a file or a folder; stopped, it leaves nothing."""

    name: str  # of its card
    out: Path
    words: tuple[str, ...]  # after `progdf`
    log: Path  # what it prints
    scene: Path  # the file that it is made from

    is_begun: ClassVar[bool] = False
    is_locked: ClassVar[bool] = False

    @property
    def result(self) -> Path:
        """What is there once it is done."""
        return self.out

    def arguments(self, resumes: bool) -> tuple[str, ...]:
        """Words after `progdf`."""
        return self.words

    def read_progress(self, before: Progress) -> Progress:
        """How far it is, by the line that it printed last."""
        line = last_line(self.log)
        frames = re.search(r"frame (\d+)/(\d+)", line)
        if frames is None:
            return Progress(before.share, line)
        return Progress(int(frames[1]) / int(frames[2]), f"frame {frames[1]} of {frames[2]}")

    def lock(self) -> AbstractContextManager[None]:
        """Nothing: each is one window's own."""
        return nullcontext()

    def save(self) -> None:
        """Nothing: it does not go on another day."""

    def discard(self) -> None:
        """Nothing: the command writes all or none."""

    def warning(self) -> str:
        """No warning."""
        return ""
