"""What a run recorded of an edit, found beside its .gdf, and shown in the field's place.

Between two snapshots the recording goes straight, as it does for the errors in the run's report.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from progdf.errors import ProgdfError
from progdf.field.trajectory import FILE_NAME, load_trajectory, peek_trajectory, recorded_field
from progdf.gdf.file import Gdf

from .layers import visible_layers
from .view_state import ViewState

NO_FILE = "the edit was not opened from a file"


@dataclass(frozen=True)
class RecordingFile:
    """Where the recording of one edit lies.

    Args:
        path: its file; None where there is none to show
        reason: why there is none
    """

    path: Path | None = None
    reason: str = ""


def find_recording(gdf: Gdf, path: Path) -> RecordingFile:
    """The recording in the run folder that the edit at `path` lies in, if it is this edit's."""
    beside = path.with_name(FILE_NAME)
    if not beside.is_file():
        return RecordingFile(reason=f"there is no {FILE_NAME} beside {path.name}")
    try:
        end, members = peek_trajectory(beside)
    except ProgdfError as error:
        return RecordingFile(reason=str(error))
    field = gdf.field
    same_end = torch.equal(end, field.offsets(1.0)) if field.attributes else not bool(end.any())
    if not same_end or not torch.equal(members, gdf.region.members):
        return RecordingFile(reason=f"the {FILE_NAME} beside {path.name} belongs to another edit")
    return RecordingFile(beside)


def load_recorded(gdf: Gdf, recording: RecordingFile) -> Gdf:
    """The edit with its recording, where the field shows it, as the field; as it is where there is none.

    Raises:
        ProgdfError: the file is gone or damaged.
    """
    if recording.path is None:
        return gdf
    trajectory, s = load_trajectory(recording.path)[0], torch.tensor(gdf.field.recorded, dtype=torch.float32)
    ascends = len(s) > 1 and float(s[0]) == 0.0 and float(s[-1]) == 1.0 and bool((s.diff() > 0).all())
    if trajectory.end.shape[0] != len(gdf.region) or len(trajectory) != len(s) or not ascends:
        raise ProgdfError(f"{recording.path} belongs to another edit; train again")
    return replace(gdf, field=recorded_field(replace(trajectory, s=s)))


def obstacle(recordings: Sequence[RecordingFile]) -> str:
    """Why there is nothing recorded to compare with; "" where there is."""
    if any(recording.path is not None for recording in recordings):
        return ""
    return (recordings[0].reason or NO_FILE) if recordings else "no edit is open"


def clamp_to_recorded(view: ViewState, recordings: Sequence[RecordingFile]) -> ViewState:
    """`view` with no recorded edit beyond its last snapshot: past 1 nothing was recorded."""
    layers = (
        replace(layer, strength=min(layer.strength, 1.0)) if recordings[layer.gdf].path else layer
        for layer in view.layers
    )
    return replace(view, layers=tuple(layers))


def describe(view: ViewState, gdfs: Sequence[Gdf], recordings: Sequence[RecordingFile]) -> str:
    """Which snapshots are shown, and which edits have none: "recorded, between 0.42 and 0.47"."""
    active = [layer for layer in visible_layers(view) if layer.strength != 0.0]
    places, fields = {}, []
    for layer in active:
        if recordings[layer.gdf].path is None:
            fields.append(layer.name)
        else:
            places[layer.name] = _neighbors(gdfs[layer.gdf].field.recorded, layer.strength)
    if len(places) < 2 and not fields:
        ends = [f"{s:.3g}" for s in next(iter(places.values()), (0.0,))]
        return f"recorded, between {ends[0]} and {ends[1]}" if len(ends) == 2 else f"recorded at {ends[0]}"
    said = [f"{name} {'–'.join(f'{s:.3g}' for s in ends)}" for name, ends in places.items()]
    parts = ("recorded: " + ", ".join(said) if said else "", "field: " + ", ".join(fields) if fields else "")
    return "; ".join(part for part in parts if part)


def _neighbors(nodes: Sequence[float], strength: float) -> tuple[float, ...]:
    """The snapshot at a strength, or those on either side of it."""
    right = min(bisect_left(nodes, strength), len(nodes) - 1)
    exact = nodes[right] <= strength
    return (nodes[right],) if exact or right == 0 else (nodes[right - 1], nodes[right])
