"""Sessions: the window's state in a file (see progdf/io/session.py), and back from it."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from progdf.errors import ProgdfError
from progdf.io.json_values import convert_json, plain
from progdf.io.session import (
    SUFFIX,
    SessionFile,
    read_session,
    reference,
    relative_name,
    verify_files,
    write_session,
)
from progdf.terminal import escape_text
from viewer.camera.view_camera import Vec3, move_camera
from viewer.state import paint
from viewer.state.selection import SUFFIX as REGION_SUFFIX
from viewer.state.selection import check as check_selection
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import LayerState, ViewState

from . import document, regions, timeline_file
from .document import Document

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class WindowSession:
    """What a session brings back."""

    document: Document
    view: ViewState
    snapshots: tuple[SliderSnapshot, ...] = ()
    warning: str = ""  # what of the file was not taken as it is, in one line


class _State(msgspec.Struct):
    """What the file holds of the window."""

    view: ViewState
    snapshots: tuple[SliderSnapshot, ...]


def save(path: Path, session: WindowSession) -> None:
    """Write the session, whole or not at all.

    Raises:
        ProgdfError: the scene or an edit has no file, a file cannot be read, or the folder does not exist.
    """
    if session.document.path is None or len(session.document.gdf_paths) != len(session.document.gdfs):
        raise ProgdfError(f"{session.document.title} was not opened from files; save the scene first")
    scene, session = session.document.path, prune(session)
    view, snapshots = _move(session.view, session.snapshots, session.document.scene.origin)
    if not path.parent.is_dir():
        raise ProgdfError(f"the folder {path.parent} does not exist; create it first")
    folder = path.parent
    state = SessionFile(
        reference(scene, folder),
        tuple(reference(gdf, folder) for gdf in session.document.gdf_paths),
        plain(_with_region_paths(view, lambda region: Path(relative_name(region, folder)))),
        tuple(plain(snapshot) for snapshot in snapshots),
    )
    write_session(path, state)


def open_session(path: Path, memory: Path | None = None) -> WindowSession:
    """Read a session with its scene and edits; what is to be said about it is logged as a warning.

    Args:
        path: its file
        memory: folder of the program's state; the user's own if None

    Raises:
        ProgdfError: it is no session, damaged or of a newer version; or a file it names is missing, broken or
            not the one it was saved with.
    """
    file = read_session(path)
    view, snapshots = _states(path.name, file)
    scene, gdfs = verify_files(path, file)
    opened = document.load(scene, gdfs)
    x, y, z = opened.scene.origin
    view, snapshots = _move(view, snapshots, (-x, -y, -z))
    check_selection(view.selection, len(opened.scene))
    named, folder = view.selection.regions, path.resolve().parent
    view = _with_region_paths(view, lambda region: Path(os.path.normpath(folder / region)))
    for layer in (*view.layers, *(layer for kept in snapshots for layer in kept.edit.layers)):
        paint.decode(layer.paint, len(opened.gdfs[layer.gdf].region))  # raises where they do not fit
    claimed = regions.claim(view.selection, regions.region_folders(path, scene, memory))
    foreign = [
        f"{old.name:.60} ({str(old.path)[:80]})"
        for old, resolved, new in zip(named, view.selection.regions, claimed.regions, strict=True)
        if new.path != resolved.path
    ]
    # no tool is in the hand when a scene is opened
    view = replace(
        view,
        selection=claimed,
        brush=replace(view.brush, active=False),
        select=replace(view.select, tool=""),
    )
    warning = ""
    if foreign:
        more = f" and {len(foreign) - 1} more" * (len(foreign) > 1)
        warning = escape_text(
            f"{path.name}: region {foreign[0]}{more} named no {REGION_SUFFIX} file in the session's folder: "
            "unsaved until the session is saved"
        )
        _log.warning(warning)
    return WindowSession(opened, view, snapshots, warning)


def _move(
    view: ViewState, snapshots: tuple[SliderSnapshot, ...], by: Vec3
) -> tuple[ViewState, tuple[SliderSnapshot, ...]]:
    """The same for a scene that lies elsewhere: a session has its cameras in the world."""
    moved = tuple(replace(kept, camera=move_camera(kept.camera, by)) for kept in snapshots)
    timeline = timeline_file.move_keys(view.timeline, by)
    return replace(view, camera=move_camera(view.camera, by), timeline=timeline), moved


def _with_region_paths(view: ViewState, change: Callable[[Path], Path]) -> ViewState:
    regions = tuple(replace(region, path=change(region.path)) for region in view.selection.regions)
    return replace(view, selection=replace(view.selection, regions=regions))


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
        found = convert_json({"view": file.view, "snapshots": list(file.snapshots)}, _State, closed=True)
        timeline_file.check(found.view.timeline, "view.timeline.keys")
        stacks = {"view": found.view.layers}
        stacks |= {f"snapshots[{i}].edit": kept.edit.layers for i, kept in enumerate(found.snapshots)}
        for where, layers in stacks.items():
            for i, layer in enumerate(layers):
                if not 0 <= layer.gdf < len(file.edits):
                    raise ValueError(f"{where}.layers[{i}].gdf is {layer.gdf} of {len(file.edits)} edits")
    except ValueError as error:
        raise ProgdfError(f"{name} cannot be opened: {error}; save it again, or update progdf") from None
    return found.view, found.snapshots
