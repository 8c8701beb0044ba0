"""Timelines as files: JSON that one can read and write by hand, edits by their names.

    {
      "progdf_timeline": 1,
      "fps": 24, "length": 72, "ping_pong": false,
      "keys": [
        {"frame": 0, "strengths": {"shirt": 0.0}, "camera": {"pivot": [0, 1, 0], "distance": 4, …}},
        {"frame": 72, "strengths": {"shirt": 1.0}, "easing": "linear"}
      ]
    }

A key without a camera leaves the camera alone; with none in any key, a film is taken from one place. A key
need not name every edit. What a key leaves out lies between its neighbors that do not.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from progdf.cli.info import TIMELINE_MARK as MARK
from progdf.errors import ProgdfError
from progdf.io.atomic import atomic_write, check_regular, open_error
from progdf.io.json_values import decode_json
from viewer.camera.view_camera import FARTHEST, ViewCamera
from viewer.state import timeline
from viewer.state.layers import OVERSHOOT
from viewer.state.view_state import Keyframe, LayerState, Timeline

from .json_form import JsonFormError, from_json, to_json

VERSION = 1
_LARGEST = 16 << 20  # bytes


@dataclass(frozen=True)
class FileKey:
    """A key as the file has it; see `Keyframe`."""

    frame: int
    strengths: dict[str, float] = field(default_factory=dict)
    camera: ViewCamera | None = None
    easing: str = "smooth"


@dataclass(frozen=True)
class TimelineFile:
    """The file; see `Timeline`."""

    progdf_timeline: int
    keys: tuple[FileKey, ...] = ()
    length: int = 72
    fps: int = 24
    ping_pong: bool = False


def save(path: Path, shown: Timeline, layers: Sequence[LayerState]) -> None:
    """Write a timeline, whole or not at all.

    Args:
        path: where to
        shown: what to write; strengths of edits that are no longer open are left out
        layers: give the edits their names

    Raises:
        ProgdfError: the folder does not exist.
        OSError: it cannot be written.
    """
    names = {layer.gdf: layer.name for layer in layers}
    keys = tuple(
        FileKey(
            key.frame, {names[gdf]: s for gdf, s in key.strengths if gdf in names}, key.camera, key.easing
        )
        for key in shown.keys
    )
    file = TimelineFile(VERSION, keys, shown.length, shown.fps, shown.ping_pong)
    with atomic_write(path) as temporary_file:
        temporary_file.write_text(json.dumps(to_json(file), indent=2) + "\n", encoding="utf-8")


def load(path: Path, layers: Sequence[LayerState]) -> Timeline:
    """Read a timeline for the edits that are open.

    Raises:
        ProgdfError: the file is missing, no timeline, damaged, of a newer version, or names an edit that is
            not open.
    """
    check_regular(path)
    try:
        with path.open("rb") as opened:
            text = opened.read(_LARGEST + 1)
    except OSError as error:
        raise open_error(path, error) from None
    try:
        value = decode_json(text) if len(text) <= _LARGEST else None
    except ValueError:
        value = None
    if not isinstance(value, dict) or MARK not in value:
        raise ProgdfError(f"{path} is not a timeline; give the .json file that Ctrl+K in the window writes")
    if value[MARK] != VERSION:
        raise ProgdfError(f"{path} is a timeline of version {value[MARK]!r}; this progdf reads {VERSION}")
    try:
        file = from_json(TimelineFile, value)
        found = _of_layers(file, layers)
        check(found, "keys")
    except JsonFormError as error:
        raise ProgdfError(f"{path} cannot be read: {error}; correct it, or write it again") from None
    return found


def check(found: Timeline, where: str = "timeline.keys") -> None:
    """Whether every value is one that the window could have made.

    Raises:
        JsonFormError: one is not; the message names it.
    """
    if not 1 <= found.length <= timeline.LONGEST or not 1 <= found.fps <= timeline.FASTEST:
        raise JsonFormError(
            f"length is {found.length} and fps {found.fps}; at most "
            f"{timeline.LONGEST} and {timeline.FASTEST} are allowed, at least 1"
        )
    for i, key in enumerate(found.keys):
        at = f"{where}[{i}]"
        if not 0 <= key.frame <= found.length:
            raise JsonFormError(f"{at}.frame is {key.frame}, outside 0 to the length, {found.length}")
        if key.easing not in timeline.EASINGS:
            raise JsonFormError(f"{at}.easing is '{key.easing}', not one of {', '.join(timeline.EASINGS)}")
        for _, strength in key.strengths:
            if not 0.0 <= strength <= OVERSHOOT:
                raise JsonFormError(f"{at}.strengths has {strength:g}, outside 0 to {OVERSHOOT:g}")
        if key.camera is not None:
            _check_camera(key.camera, f"{at}.camera")
    if any(before.frame >= after.frame for before, after in pairwise(found.keys)):
        raise JsonFormError(f"{where} has two keys at one frame, or not in their order")


def _of_layers(file: TimelineFile, layers: Sequence[LayerState]) -> Timeline:
    gdfs = {layer.name: layer.gdf for layer in layers}
    for key in file.keys:
        for name in key.strengths:
            if name not in gdfs:
                there = ", ".join(gdfs) or "none"
                raise JsonFormError(f"it moves the edit '{name}', which is not open (there is {there})")
    keys = sorted(file.keys, key=lambda key: key.frame)
    return Timeline(
        tuple(
            Keyframe(k.frame, tuple((gdfs[n], s) for n, s in k.strengths.items()), k.camera, k.easing)
            for k in keys
        ),
        file.length,
        file.fps,
        file.ping_pong,
    )


def _check_camera(camera: ViewCamera, where: str) -> None:
    numbers = (*camera.pivot, camera.azimuth, camera.distance, *camera.up)
    if not all(abs(number) <= FARTHEST for number in numbers):
        raise JsonFormError(f"{where} is farther away than {FARTHEST:g}")
    if camera.distance <= 0.0 or not any(camera.up):
        raise JsonFormError(f"{where} has a distance that is not above 0, or an up axis without a direction")
    if abs(camera.elevation) > 90.0 or not 1.0 <= camera.fov_y <= 179.0:
        raise JsonFormError(f"{where} has an elevation outside -90 to 90, or a lens outside 1 to 179 degrees")
