"""Sessions: the window's state in a file (see progdf/io/session.py), and back from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from progdf.compose.layers import BLENDS
from progdf.errors import ProgdfError
from progdf.io.session import SUFFIX, SessionFile, read_session, reference, verify_files, write_session
from viewer.camera.view_camera import FARTHEST, ViewCamera
from viewer.state import paint
from viewer.state.comparison import AGAINST, MODES, MOST_AMPLIFIED
from viewer.state.history import Edit
from viewer.state.layers import OVERSHOOT
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import RESOLUTION_MODES, LayerState, ViewState

from . import document, timeline_file
from .document import Document
from .json_form import JsonFormError, from_json, to_json


@dataclass(frozen=True)
class WindowSession:
    """What a session brings back."""

    document: Document
    view: ViewState
    snapshots: tuple[SliderSnapshot, ...] = ()


def save(path: Path, session: WindowSession) -> None:
    """Write the session, whole or not at all.

    Raises:
        ProgdfError: the scene or an edit has no file, a file cannot be read, or the folder does not exist.
    """
    if session.document.path is None or len(session.document.gdf_paths) != len(session.document.gdfs):
        raise ProgdfError(f"{session.document.title} was not opened from files; save the scene first")
    scene, session = session.document.path, prune(session)
    if not path.parent.is_dir():
        raise ProgdfError(f"the folder {path.parent} does not exist; create it first")
    folder = path.parent
    state = SessionFile(
        reference(scene, folder),
        tuple(reference(gdf, folder) for gdf in session.document.gdf_paths),
        to_json(session.view),
        tuple(to_json(snapshot) for snapshot in session.snapshots),
    )
    write_session(path, state)


def open_session(path: Path) -> WindowSession:
    """Read a session with its scene and edits.

    Raises:
        ProgdfError: it is no session, damaged or of a newer version; or a file it names is missing, broken or
            not the one it was saved with.
    """
    file = read_session(path)
    view, snapshots = _states(path.name, file)
    scene, gdfs = verify_files(path, file)
    opened = document.load(scene, gdfs)
    for layer in (*view.layers, *(layer for kept in snapshots for layer in kept.edit.layers)):
        paint.decode(layer.paint, len(opened.gdfs[layer.gdf].region))  # raises where they do not fit
    return WindowSession(opened, view, snapshots)


def default_path(opened: Document) -> Path:
    """What a session of it is called if nobody says otherwise: as the scene, and beside it."""
    scene = opened.path or Path(opened.title)
    return scene.with_name(scene.stem + SUFFIX)


def prune(session: WindowSession) -> WindowSession:
    """Without the edits that no layer shows any more, in the view or in a snapshot."""
    view, snapshots = session.view, session.snapshots
    stacks = (view.layers, *(kept.edit.layers for kept in snapshots))
    used = sorted({layer.gdf for layers in stacks for layer in layers})
    places = {gdf: i for i, gdf in enumerate(used)}

    def renumber(layers: tuple[LayerState, ...]) -> tuple[LayerState, ...]:
        return tuple(replace(layer, gdf=places[layer.gdf]) for layer in layers)

    opened = session.document
    if len(used) == len(opened.gdfs):
        return session
    keys = tuple(
        replace(key, strengths=tuple((places[gdf], s) for gdf, s in key.strengths if gdf in places))
        for key in view.timeline.keys
    )
    return WindowSession(
        replace(
            opened,
            gdfs=tuple(opened.gdfs[gdf] for gdf in used),
            gdf_paths=tuple(opened.gdf_paths[gdf] for gdf in used),
        ),
        replace(
            view,
            layers=renumber(view.layers),
            timeline=replace(view.timeline, keys=keys),
            unfolded=tuple(places[gdf] for gdf in view.unfolded if gdf in places),
        ),
        tuple(
            replace(kept, edit=replace(kept.edit, layers=renumber(kept.edit.layers))) for kept in snapshots
        ),
    )


def _states(name: str, file: SessionFile) -> tuple[ViewState, tuple[SliderSnapshot, ...]]:
    """The state of a session, every value of it one that the window could have made."""
    try:
        view = from_json(ViewState, file.view, "view")
        snapshots = tuple(
            from_json(SliderSnapshot, entry, f"snapshots[{i}]") for i, entry in enumerate(file.snapshots)
        )
        count = len(file.edits)
        _check_camera("view.camera", view.camera)
        _check_edit("view", Edit(view.layers, view.blend), count)
        timeline_file.check(view.timeline, "view.timeline.keys")
        _check("view.background", view.background, 0.0, 1.0)
        _check("view.compare.divider", [view.compare.divider], 0.0, 1.0)
        _check("view.compare.amplify", [view.compare.amplify], 1.0, MOST_AMPLIFIED)
        _check_known("view.compare.mode", view.compare.mode, MODES)
        _check_known("view.compare.against", view.compare.against, AGAINST)
        _check_known("view.dynamic_resolution", view.dynamic_resolution, RESOLUTION_MODES)
        _check_known("view.brush.mode", view.brush.mode, paint.MODES)
        _check("view.brush.radius", [view.brush.radius], paint.SMALLEST_PX, paint.LARGEST_PX)
        _check("view.brush.softness", [view.brush.softness], 0.0, 1.0)
        timeline_file.check(view.timeline, "view.timeline.keys")
        for i, snapshot in enumerate(snapshots):
            _check_camera(f"snapshots[{i}].camera", snapshot.camera)
            _check_edit(f"snapshots[{i}].edit", snapshot.edit, count)
    except JsonFormError as error:
        raise ProgdfError(f"{name} cannot be opened: {error}; save it again, or update progdf") from None
    return view, snapshots


def _check_edit(where: str, edit: Edit, count: int) -> None:
    _check_known(f"{where}.blend", edit.blend, BLENDS)
    for i, layer in enumerate(edit.layers):
        at = f"{where}.layers[{i}]"
        if not 0 <= layer.gdf < count:
            raise JsonFormError(f"{at}.gdf is {layer.gdf} of {count} edits")
        _check(f"{at}.strength", [layer.strength], 0.0, OVERSHOOT)
        gains = layer.gains
        _check(f"{at}.gains", [gains.geometry, gains.opacity, gains.color], 0.0, 1.0)


def _check_camera(where: str, camera: ViewCamera) -> None:
    _check(where, [*camera.pivot, camera.azimuth], -FARTHEST, FARTHEST)
    _check(f"{where}.distance", [camera.distance], math.ulp(0.0), FARTHEST)
    _check(f"{where}.elevation", [camera.elevation], -90.0, 90.0)
    _check(f"{where}.fov_y", [camera.fov_y], 1.0, 179.0)
    _check(f"{where}.up", camera.up, -FARTHEST, FARTHEST)
    _check_known(f"{where}.mode", camera.mode, ("orbit", "fly"))


def _check(where: str, values: Sequence[float], least: float, most: float) -> None:
    for value in values:
        if not least <= value <= most:
            raise JsonFormError(f"{where} is {value:g}, outside {least:g} to {most:g}")


def _check_known(where: str, value: Any, known: Sequence[str]) -> None:
    if value not in known:
        raise JsonFormError(f"{where} is '{value}', not one of {', '.join(known)}")
