"""Process `progdf preview` of one scene, which answers requests for grades and pictures."""

from __future__ import annotations

import contextlib
import itertools
import tempfile
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.errors import without_commands
from progdf.io.json_values import convert_json, decode_json, to_json
from viewer.camera.view_camera import Vec3, ViewCamera

from .child import Child


@dataclass(frozen=True)
class PreviewInputs:
    """Inputs that determine a preview."""

    region: str
    editor: str
    strength: float
    camera: ViewCamera
    size: tuple[int, int]  # size of the view, pixels
    background: Vec3
    model: str = ""  # diffusion model, for a sentence
    seed: int = 0  # random seed, for a sentence; -1 asks only for the available models
    api_url: str = ""  # address of a server that receives the picture
    prompt: str = ""  # text for a workflow
    estimate: bool = False  # also request an estimate of how close training will come to a picture

    @property
    def of_all_views(self) -> tuple[str, str]:
        """Region and editor, which determine a grade in every view."""
        return self.region, self.editor

    @property
    def kind(self) -> tuple[str, str]:
        """Region and editor family. A change of either makes the running preview obsolete."""
        return self.region, self.editor.partition(":")[0]


@dataclass(frozen=True, eq=False)
class RegionSample:
    """Rows of a region, and the colors of its visible pixels in some views."""

    rows: NDArray[np.int64]  # ascending. [M]
    colors: NDArray[np.float32]  # the region's own colors, sRGB 0 to 1. [P,3]
    shares: NDArray[np.float32]  # the region's share of each pixel, 0 to 1. [P]
    image: NDArray[np.float32]  # small picture of the current view, 0 to 1. [H,W,3]
    inside: NDArray[np.float32]  # the region's own colors in it. [H,W,3]
    mask: NDArray[np.float32]  # the region's share of its pixels. [H,W]


@dataclass(frozen=True)
class Preview:
    """Answer to a request: a picture, a grade's file, a palette, a note or an error."""

    number: int  # -1: the process has ended, or its output cannot be read
    pixels: Any = None  # the picture. [H,W,3] uint8
    grade: Path | None = None
    error: str = ""
    made: Literal["picture", "grade", "note", "palette", "near"] = "picture"
    note: str = ""  # description of the model for a sentence, or of `near`
    near: str = ""  # expected difference of the trained edit: close, roughly or far; "" if not known
    models: tuple[str, ...] = ()  # models on this machine
    follows: bool = False  # the edit of a sentence can follow this picture
    palette: tuple[str, ...] = ()  # main colors of the region, #rrggbb
    sample: RegionSample | None = None  # beside a palette


def _read_sample(path: Path) -> RegionSample:
    """Read the sample of a region that the process has written."""
    with np.load(path) as arrays:
        names = ("rows", "colors", "shares", "image", "inside", "mask")
        return RegionSample(*(arrays[name] for name in names))


class PreviewChild:
    """Preview process of one scene, which answers the latest request. `close` it.

    Args:
        scene: file of the scene
        on_answer: called in another thread when an answer has arrived

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(self, scene: Path, on_answer: Callable[[], None]) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="progdf-preview-")
        self._numbers = itertools.count(1)
        self._answers: deque[str] = deque()
        self._on_answer = on_answer
        self._child = Child(["preview", str(scene)], self.folder / "log.txt", talks=True)
        threading.Thread(target=self._listen, daemon=True).start()

    @property
    def folder(self) -> Path:
        """Folder of the pictures and of the files that requests name."""
        return Path(self._folder.name)

    def ask(self, region: str, request: PreviewInputs, camera: Camera) -> int:
        """Request a grade or a picture and return the request's number."""
        number = next(self._numbers)
        values = to_json(request) | {"number": number, "out": str(self._picture(number)), "region": region}
        values |= {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist()}
        values |= {"width": camera.width, "height": camera.height}
        self._child.send(msgspec.json.encode(values).decode())
        return number

    def take(self) -> Preview | None:
        """Return the next answer, or the error of an ended process; None without one. Does not wait."""
        line = self._answers.popleft() if self._answers else None
        if line is None:
            ended = self._child.status is not None
            return (
                Preview(-1, error=without_commands(self._child.error()) or "the preview ended")
                if ended
                else None
            )
        try:
            answer = convert_json(decode_json(line), Preview)
            if answer.error or answer.made in ("note", "near"):
                return replace(answer, error=without_commands(answer.error))
            if answer.made == "palette":
                return replace(answer, sample=_read_sample(self._picture(answer.number).with_suffix(".npz")))
            if answer.made == "grade":
                return replace(answer, grade=self._picture(answer.number).with_suffix(".gdf"))
            with Image.open(self._picture(answer.number)) as picture:
                return replace(answer, pixels=np.asarray(picture.convert("RGB")))
        except (OSError, ValueError) as error:
            return Preview(-1, error=f"the preview cannot be read: {error}")

    def close(self) -> None:
        """End the process."""
        self._child.kill()  # it has no state to save
        self._child.close()
        with contextlib.suppress(OSError):
            self._folder.cleanup()

    def _picture(self, number: int) -> Path:
        return self.folder / f"{number % 8}.png"

    def _listen(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            for line in self._child.output:
                self._answers.append(line.decode("utf-8", "replace"))
                self._on_answer()
