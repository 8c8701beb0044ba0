"""What the window delivers by child processes: an exported scene, a picture, a film."""

from __future__ import annotations

import itertools
import re
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from .child import Child, last_line

Status = Literal["running", "stopping", "failed", "done", "stopped"]
FORMATS = (".mp4", ".gif", "")
"""Of films: two kinds of files, and a folder of frames."""
FORMAT_NAMES = ("MP4", "GIF", "PNG frames")
SIZES = ((1280, 720), (1920, 1080), (2560, 1440), (3840, 2160))
FPS = (12, 24, 25, 30, 60)


@dataclass(frozen=True)
class DeliverOptions:
    """What a picture or a film is asked for.

    Args:
        width, height: pixels
        alpha: the background is transparent
        fps: frames a second
        seconds: of a film that moves a slider there and back
        format: of `FORMATS`
        moves: "timeline", or the name of the layer whose slider moves
        can_move: what there is to choose from
    """

    width: int = 1920
    height: int = 1080
    alpha: bool = False
    fps: int = 24
    seconds: float = 4.0
    format: str = ".mp4"
    moves: str = ""
    can_move: tuple[str, ...] = ()


@dataclass(frozen=True)
class Delivery:
    """One of them, as the panel shows it.

    Args:
        number: what it is called by
        title: what it is
        out: the file or folder
        status: where it stands
        done, total: frames; 0 of 0 while nothing is known
        note: what the command said last
        seconds: that it has run, whole ones
        error: the one line of a failure
        starved: other programs keep the processor
        scene: the file that it is made from
        elsewhere: the name of that where another scene is open, else ""
    """

    number: int
    title: str
    out: Path
    status: Status = "running"
    done: int = 0
    total: int = 0
    note: str = ""
    seconds: int = 0
    error: str = ""
    starved: bool = False
    scene: Path | None = None
    elsewhere: str = ""

    @property
    def seconds_left(self) -> float | None:
        """By how long the rest should take."""
        if self.status != "running" or self.done < 2 or not self.total:
            return None
        return self.seconds * (self.total - self.done) / self.done


class Deliveries:
    """Children that write what is delivered. `close` it with the window."""

    def __init__(self) -> None:
        self.shown: tuple[Delivery, ...] = ()
        self._numbers = itertools.count(1)
        self._children: dict[int, Child] = {}
        self._began: dict[int, float] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="progdf-deliver-")

    @property
    def folder(self) -> Path:
        """For files that commands read."""
        return Path(self._folder.name)

    def start(self, title: str, out: Path, arguments: Sequence[str], scene: Path | None) -> None:
        """Run a command that writes `out` from a scene.

        Raises:
            OSError: it cannot be started.
        """
        number = next(self._numbers)
        self._children[number] = Child(arguments, self.folder / f"{number}.log")
        self._began[number] = time.monotonic()
        self.shown = (*self.shown, Delivery(number, title, out, scene=scene))

    def stop(self, number: int) -> None:
        """Stop one, or take one that failed off the list."""
        delivery = next((shown for shown in self.shown if shown.number == number), None)
        if delivery is not None and number in self._children:
            self._children[number].stop()
            self._change(replace(delivery, status="stopping"))
        else:
            self.shown = tuple(shown for shown in self.shown if shown.number != number)

    def poll(self) -> list[Delivery]:
        """Look at the children; those that have just ended, well or not."""
        ended = []
        for delivery in self.shown:
            child = self._children.get(delivery.number)
            if child is None:
                continue
            status = child.status
            if status is None:
                seconds = int(time.monotonic() - self._began[delivery.number])
                if seconds != delivery.seconds:  # each look is a frame of the window
                    note = last_line(child.log)
                    found = re.search(r"frame (\d+)/(\d+)", note)
                    done, total = (int(found[1]), int(found[2])) if found else (0, 0)
                    seen = replace(delivery, done=done, total=total, note=note, seconds=seconds)
                    self._change(replace(seen, starved=child.starved))
                continue
            self._children.pop(delivery.number).close()
            if status and delivery.status != "stopping":
                failed = replace(delivery, status="failed", error=child.error() or f"status {status}")
                ended.append(self._change(failed))
                continue
            self.shown = tuple(shown for shown in self.shown if shown.number != delivery.number)
            ended.append(replace(delivery, status="stopped" if status else "done"))
        return ended

    @property
    def busy(self) -> bool:
        """Whether something is being written."""
        return bool(self._children)

    def close(self) -> None:
        """Stop all of it; what is not whole is not kept."""
        for child in self._children.values():
            child.stop()
        for child in self._children.values():
            child.close()
        self._children.clear()
        self._folder.cleanup()

    def _change(self, delivery: Delivery) -> Delivery:
        self.shown = tuple(delivery if old.number == delivery.number else old for old in self.shown)
        return delivery
