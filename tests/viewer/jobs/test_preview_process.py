"""Answers of the preview process."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from viewer.jobs import preview_process


class Answering:
    """Stub of a child that has written two answers to one request."""

    status = None

    def __init__(self, *_: Any, **__: Any) -> None:
        self.output = [b'{"number": 1}\n', b'{"number": 1, "made": "near", "near": "close"}\n']

    def kill(self) -> None:
        pass

    def close(self) -> None:
        pass


def test_picture_is_taken_before_the_estimate_that_follows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preview_process, "Child", Answering)
    arrived = threading.Semaphore(0)
    child = preview_process.PreviewChild(Path("scene.ply"), arrived.release)
    Image.new("RGB", (4, 3), (9, 9, 9)).save(child.folder / "1.png")
    for _ in range(2):
        assert arrived.acquire(timeout=5)
    picture = child.take()
    assert picture is not None
    assert np.shape(picture.pixels) == (3, 4, 3)
    estimate = child.take()
    assert estimate is not None
    assert (estimate.made, estimate.near) == ("near", "close")
    assert child.take() is None
    child.close()
