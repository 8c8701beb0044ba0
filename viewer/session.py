"""Sessions: the window's state in a file (see progdf/session_file.py), and back from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from progdf.errors import ProgdfError
from progdf.layers import BLENDS
from progdf.session_file import SUFFIX, SessionFile, read_session, reference, verified, write_session

from . import document, draft, paint, plain, timeline_file
from .compare import AGAINST, MODES, MOST_AMPLIFIED
from .document import Document
from .history import Edit
from .plain import NotPlainError
from .snapshots import Snapshot
from .stack import OVERSHOOT
from .state import ViewCamera, ViewState
from .turntable import FARTHEST

AUTOSAVE = ".autosave"


@dataclass(frozen=True)
class Session:
    """What a session brings back."""

    document: Document
    view: ViewState
    snapshots: tuple[Snapshot, ...] = ()


def save(path: Path, session: Session) -> None:
    """Write the session, whole or not at all.

    Raises:
        ProgdfError: the scene or an edit has no file, a file cannot be read, or the folder does not exist.
    """
    opened = session.document
    if opened.path is None or len(opened.gdf_paths) != len(opened.gdfs):
        raise ProgdfError(f"{opened.title} was not opened from files; save the scene first")
    if not path.parent.is_dir():
        raise ProgdfError(f"the folder {path.parent} does not exist; make it first")
    folder = path.parent
    state = SessionFile(
        reference(opened.path, folder),
        tuple(reference(gdf, folder) for gdf in opened.gdf_paths),
        plain.plain(session.view),
        tuple(plain.plain(snapshot) for snapshot in session.snapshots),
    )
    write_session(path, state)


def open_session(path: Path) -> Session:
    """Read a session with its scene and edits.

    Raises:
        ProgdfError: it is no session, damaged or of a newer version; or a file it names is missing, broken or
            not the one it was saved with.
    """
    file = read_session(path)
    view, snapshots = _states(path.name, file)
    scene, gdfs = verified(path, file)
    opened = document.load(scene, gdfs)
    for layer in (*view.layers, *(layer for kept in snapshots for layer in kept.edit.layers)):
        paint.decoded(layer.paint, len(opened.gdfs[layer.gdf].region))  # raises where they do not fit
    return Session(opened, view, snapshots)


def default_path(opened: Document) -> Path:
    """Where a session of it is saved if nobody says otherwise: beside the scene."""
    scene = opened.path or Path(opened.title)
    return scene.with_name(scene.stem + SUFFIX)


def autosave_path(session: Path | None, opened: Document) -> Path:
    """Where unsaved work is kept: beside the session, or beside where it would be."""
    path = session or default_path(opened)
    name = path.name.removesuffix(SUFFIX) if path.name.endswith(SUFFIX) else path.stem
    return path.with_name(f"{name}{AUTOSAVE}{SUFFIX}")


def _states(name: str, file: SessionFile) -> tuple[ViewState, tuple[Snapshot, ...]]:
    """The state of a session, every value of it one that the window could have made."""
    try:
        view = plain.restored(ViewState, file.view, "view")
        snapshots = tuple(
            plain.restored(Snapshot, entry, f"snapshots[{i}]") for i, entry in enumerate(file.snapshots)
        )
        count = len(file.edits)
        _check_camera("view.camera", view.camera)
        _check_edit("view", Edit(view.layers, view.blend), count)
        timeline_file.check(view.timeline, "view.timeline.keys")
        _check("view.background", view.background, 0.0, 1.0)
        _check("view.compare.divider", [view.compare.divider], 0.0, 1.0)
        _check("view.compare.amplify", [view.compare.amplify], 1.0, MOST_AMPLIFIED)
        _among("view.compare.mode", view.compare.mode, MODES)
        _among("view.compare.against", view.compare.against, AGAINST)
        _among("view.draft", view.draft, draft.MODES)
        _among("view.brush.mode", view.brush.mode, paint.MODES)
        _check("view.brush.radius", [view.brush.radius], paint.SMALLEST_PX, paint.LARGEST_PX)
        _check("view.brush.softness", [view.brush.softness], 0.0, 1.0)
        timeline_file.check(view.timeline, "view.timeline.keys")
        for i, snapshot in enumerate(snapshots):
            _check_camera(f"snapshots[{i}].camera", snapshot.camera)
            _check_edit(f"snapshots[{i}].edit", snapshot.edit, count)
    except NotPlainError as error:
        raise ProgdfError(f"{name} cannot be opened: {error}; save it anew, or update progdf") from None
    return view, snapshots


def _check_edit(where: str, edit: Edit, count: int) -> None:
    _among(f"{where}.blend", edit.blend, BLENDS)
    for i, layer in enumerate(edit.layers):
        at = f"{where}.layers[{i}]"
        if not 0 <= layer.gdf < count:
            raise NotPlainError(f"{at}.gdf is {layer.gdf} of {count} edits")
        _check(f"{at}.strength", [layer.strength], 0.0, OVERSHOOT)
        gains = layer.gains
        _check(f"{at}.gains", [gains.geometry, gains.opacity, gains.colour], 0.0, 1.0)


def _check_camera(where: str, camera: ViewCamera) -> None:
    _check(where, [*camera.pivot, camera.azimuth], -FARTHEST, FARTHEST)
    _check(f"{where}.distance", [camera.distance], math.ulp(0.0), FARTHEST)
    _check(f"{where}.elevation", [camera.elevation], -90.0, 90.0)
    _check(f"{where}.fov_y", [camera.fov_y], 1.0, 179.0)
    _check(f"{where}.up", camera.up, -FARTHEST, FARTHEST)
    _among(f"{where}.mode", camera.mode, ("orbit", "fly"))


def _check(where: str, values: Sequence[float], least: float, most: float) -> None:
    for value in values:
        if not least <= value <= most:
            raise NotPlainError(f"{where} is {value:g}, outside {least:g} to {most:g}")


def _among(where: str, value: Any, known: Sequence[str]) -> None:
    if value not in known:
        raise NotPlainError(f"{where} is '{value}', none of {', '.join(known)}")
