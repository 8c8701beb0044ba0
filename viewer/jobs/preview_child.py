"""The child that makes an editor's own pictures of views (`progdf preview`); the latest request wins."""

from __future__ import annotations

import contextlib
import itertools
import tempfile
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.io.json_values import convert_json, decode_json

from .child import Child


@dataclass(frozen=True)
class PreviewPicture:
    """What came of a request: a picture [H,W,3], or None and why there is none."""

    number: int
    pixels: NDArray[np.uint8] | None
    error: str = ""


class _Answer(msgspec.Struct):
    number: int
    error: str = ""


class PreviewChild:
    """One child for one scene. `close` it.

    Args:
        scene: its file

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, scene: Path) -> None:
        self.scene = scene
        self._folder = tempfile.TemporaryDirectory(prefix="progdf-preview-")
        self._numbers = itertools.count(1)
        self._answers: deque[str] = deque()
        self._child = Child(["preview", str(scene)], self.folder / "log.txt", talks=True)
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def folder(self) -> Path:
        """Where its pictures go, and files that its requests name."""
        return Path(self._folder.name)

    def ask(
        self,
        region: str,
        editor: str,
        strength: float,
        camera: Camera,
        background: tuple[float, float, float],
    ) -> int:
        """Ask for a picture; its number."""
        number = next(self._numbers)
        asked = {
            "number": number,
            "out": str(self.folder / f"{number % 8}.png"),
            "region": region,
            "editor": editor,
            "strength": strength,
            "background": background,
            "viewmat": camera.viewmat.tolist(),
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
        }
        self._child.send(msgspec.json.encode(asked).decode())
        return number

    def take(self) -> PreviewPicture | None:
        """The last answer since the last call; a child that has ended says why. Does not wait."""
        found = None
        while self._answers:
            found = self._answers.popleft()
        if found is None:
            ended = self._child.status is not None
            return PreviewPicture(-1, None, self._child.error() or "the preview ended") if ended else None
        try:
            told = convert_json(decode_json(found), _Answer)
            if told.error:
                return PreviewPicture(told.number, None, told.error)
            with Image.open(self.folder / f"{told.number % 8}.png") as picture:
                return PreviewPicture(told.number, np.asarray(picture.convert("RGB")))
        except (OSError, ValueError) as error:
            return PreviewPicture(-1, None, f"the preview cannot be read: {error}")

    def close(self) -> None:
        """End it."""
        self._child.kill()  # it keeps nothing
        self._child.close()
        with contextlib.suppress(OSError):
            self._folder.cleanup()

    def _listen(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            for line in self._child.output:
                self._answers.append(line.decode("utf-8", "replace"))
