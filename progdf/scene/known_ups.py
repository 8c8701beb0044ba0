"""Which way is up in a scene, as a person chose: JSON in the user's program state, by the scene's content.

So `train`, `render` and the window agree, wherever the file lies and whatever it is called.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import torch
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.gdf.file import fingerprint
from progdf.io.atomic import atomic_write, state_folder
from progdf.io.json_values import decode_json

MOST = 200
"""Scenes that are remembered; the oldest go."""


def find(scene: Gaussians) -> Tensor | None:
    """What was chosen for a scene, [3] unit length; None where nothing was."""
    known = _read()
    numbers = known.get(fingerprint(scene).means_sha256) if known else None
    try:
        up = torch.tensor(numbers, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError):
        return None
    usable = up.shape == (3,) and bool(up.isfinite().all()) and float(up.norm()) > 1e-6
    return up / up.norm() if usable else None


def remember(scene: Gaussians, up: tuple[float, float, float]) -> None:
    """Keep what was chosen for a scene; what cannot be written is not remembered."""
    key = fingerprint(scene).means_sha256
    kept = {name: known for name, known in _read().items() if name != key} | {key: list(up)}
    with contextlib.suppress(OSError):
        _place().parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(_place()) as temporary_file:
            temporary_file.write_text(json.dumps(dict([*kept.items()][-MOST:])), encoding="utf-8")


def _read() -> dict[str, object]:
    try:
        known = decode_json(_place().read_bytes())
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _place() -> Path:
    return state_folder() / "up_axes.json"
