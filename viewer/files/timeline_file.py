"""Timelines as files: JSON that one can read and write by hand, edits by their names.

    {
      "progdf_timeline": 1,
      "fps": 24, "length": 72, "ping_pong": false,
      "keys": [
        {"frame": 0, "strengths": {"shirt": 0.0}, "camera": {"pivot": [0, 1, 0], "distance": 4, …}},
        {"frame": 72, "strengths": {"shirt": 1.0}, "easing": "linear"}
      ]
    }

Cameras are in the world. A key without one leaves the camera alone; with none in any key, a film is taken
from one place. A key need not name every edit: what it leaves out lies between its neighbors that do not, and
several keys stand at one frame where they move different things.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import msgspec

from progdf.cli.info import TIMELINE_MARK as MARK
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin
from progdf.io.atomic import atomic_write, read_file
from progdf.io.json_values import convert_json, decode_json, plain
from viewer.camera.view_camera import Vec3, ViewCamera, move_camera
from viewer.state.timeline import split_keys
from viewer.state.view_state import Easing, Fps, Frame, Keyframe, LayerState, Length, Strength, Timeline

VERSION = 1
_LARGEST = 16 << 20  # bytes


class FileKey(msgspec.Struct, frozen=True):
    """A key as the file has it; see `Keyframe`."""

    frame: Frame
    strengths: dict[str, Strength] = {}
    camera: ViewCamera | None = None
    easing: Easing = "smooth"


class TimelineFile(msgspec.Struct, frozen=True):
    """The file; see `Timeline`."""

    progdf_timeline: int
    keys: tuple[FileKey, ...] = ()
    length: Length = 72
    fps: Fps = 24
    ping_pong: bool = False


def move_keys(timeline: Timeline, by: Vec3) -> Timeline:
    """The same film of a scene that lies elsewhere; see `move_camera`."""
    return replace(
        timeline,
        keys=tuple(
            replace(key, camera=None if key.camera is None else move_camera(key.camera, by))
            for key in timeline.keys
        ),
    )


def save(path: Path, timeline: Timeline, layers: Sequence[LayerState], origin: Origin = ZERO) -> None:
    """Write a timeline, its cameras in the world, whole or not at all.

    Args:
        path: where to
        timeline: what to write; strengths of edits that are no longer open are left out
        layers: give the edits their names
        origin: of the scene, which the cameras are relative to

    Raises:
        ProgdfError: the folder does not exist.
        OSError: it cannot be written.
    """
    timeline = move_keys(timeline, origin)
    names = {layer.gdf: layer.name for layer in layers}
    keys = tuple(
        FileKey(
            key.frame, {names[gdf]: s for gdf, s in key.strengths if gdf in names}, key.camera, key.easing
        )
        for key in timeline.keys
    )
    file = TimelineFile(VERSION, keys, timeline.length, timeline.fps, timeline.ping_pong)
    with atomic_write(path) as temporary_file:
        temporary_file.write_text(json.dumps(plain(file), indent=2) + "\n", encoding="utf-8")


def load(path: Path, layers: Sequence[LayerState], origin: Origin = ZERO) -> Timeline:
    """Read a timeline for the edits that are open, its cameras relative to the origin of the scene.

    Raises:
        ProgdfError: the file is missing, no timeline, damaged, of a newer version, or names an edit that is
            not open.
    """
    text = read_file(path, _LARGEST + 1)
    try:
        value = decode_json(text) if len(text) <= _LARGEST else None
    except ValueError:
        value = None
    if not isinstance(value, dict) or MARK not in value:
        raise ProgdfError(f"{path} is not a timeline; give the .json file as which the window saves one")
    if value[MARK] != VERSION:
        raise ProgdfError(f"{path} is a timeline of version {value[MARK]!r}; this progdf reads {VERSION}")
    try:
        file = convert_json(value, TimelineFile, closed=True)
        timeline = _of_layers(file, layers)
        check(timeline, "keys")
    except ValueError as error:
        raise ProgdfError(f"{path} cannot be read: {error}; correct it, or write it again") from None
    x, y, z = origin
    return move_keys(timeline, (-x, -y, -z))


def check(timeline: Timeline, where: str) -> None:
    """Whether the keys fit each other and the length.

    Raises:
        ValueError: they do not; the message names the key.
    """
    for i, key in enumerate(timeline.keys):
        if key.frame > timeline.length:
            raise ValueError(f"{where}[{i}].frame is {key.frame}, outside 0 to the length, {timeline.length}")
        if key.camera is not None and not any(key.camera.up):
            raise ValueError(f"{where}[{i}].camera has an up axis without a direction")
    rows = [row for key in timeline.keys for row in split_keys(Timeline((key,))) or [(None, key.frame)]]
    if len(set(rows)) < len(rows) or any(a.frame > b.frame for a, b in pairwise(timeline.keys)):
        raise ValueError(f"{where} has two keys of one row at one frame, or not in their order")


def _of_layers(file: TimelineFile, layers: Sequence[LayerState]) -> Timeline:
    gdfs = {layer.name: layer.gdf for layer in layers}
    for key in file.keys:
        for name in key.strengths:
            if name not in gdfs:
                there = ", ".join(gdfs) or "none"
                raise ValueError(f"it moves the edit '{name}', which is not open (there is {there})")
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
