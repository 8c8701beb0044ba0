"""Sessions: the window's state in a file, and back from it; beside it the autosave of unsaved work.

- bear.session.json: the session, a `WindowFile`; for a scene that never had one, the name it would get
- bear.autosave.session.json: its unsaved work; -2, -3 … where others wait for somebody to decide about them
- bear.discarded.session.json: work that was discarded, the last `MAX_DISCARDED`
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.io.atomic import numbered_names, replace_file
from progdf.io.session import (
    SUFFIX,
    EditRef,
    SessionFile,
    read_session,
    reference,
    relative_name,
    verify_files,
    write_session,
)
from progdf.region import Region, from_mask
from progdf.terminal import escape_text
from viewer.camera.view_camera import Vec3, move_camera
from viewer.state import paint
from viewer.state.selection import SUFFIX as REGION_SUFFIX
from viewer.state.selection import check as check_selection
from viewer.state.selection import pack, take_rows, unpack
from viewer.state.snapshots import SliderSnapshot
from viewer.state.timeline import split_keys
from viewer.state.view_state import LayerState, Timeline, ViewState

from . import document, exports
from .document import Document

_log = logging.getLogger(__name__)


AUTOSAVE_S = 20.0
"""Seconds from a change to its autosave."""

MAX_DISCARDED = 3
_KINDS = "autosave", "discarded"


@dataclass(frozen=True)
class WindowSession:
    """What a session brings back."""

    document: Document
    view: ViewState
    snapshots: tuple[SliderSnapshot, ...] = ()
    warning: str = ""  # what of the file was not taken as it is, in one line


class WindowFile(SessionFile, frozen=True, forbid_unknown_fields=True):
    """The file's schema: the scene and the edits as references, and the state of the window as it is."""

    view: ViewState = ViewState()  # type: ignore[assignment]
    snapshots: tuple[SliderSnapshot, ...] = ()  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Every value is one that the window could have made."""
        _check_keys(self.view.timeline, "view.timeline.keys")
        stacks = {"view": self.view.layers}
        stacks |= {f"snapshots[{i}].edit": snapshot.edit.layers for i, snapshot in enumerate(self.snapshots)}
        for where, layers in stacks.items():
            for i, layer in enumerate(layers):
                if not 0 <= layer.gdf < len(self.edits):
                    raise ValueError(f"{where}.layers[{i}].gdf is {layer.gdf} of {len(self.edits)} edits")


def save(path: Path, session: WindowSession) -> None:
    """Write the session, whole or not at all.

    Raises:
        ProgdfError: the scene or an edit has no file, a file cannot be read, or the folder does not exist.
    """
    if session.document.path is None or len(session.document.gdf_paths) != len(session.document.edits):
        raise ProgdfError(f"{session.document.title} was not opened from files; save the scene first")
    scene = session.document.path
    session = prune(session)
    view, snapshots = _move(session.view, session.snapshots, session.document.scene.origin)
    if not path.parent.is_dir():
        raise ProgdfError(f"the folder {path.parent} does not exist; create it first")
    folder = path.parent
    view = _with_region_paths(view, lambda region: Path(relative_name(region, folder)))
    opened = session.document
    edits = tuple(
        _edit_ref(gdf, path, folder) for gdf, path in zip(opened.edits, opened.gdf_paths, strict=True)
    )
    write_session(path, WindowFile(reference(scene, folder), edits, view, snapshots))


def _edit_ref(gdf: Gdf, path: Path, folder: Path) -> EditRef:
    file = reference(path, folder)
    if not gdf.applied:
        return EditRef(file.file, file.sha256)
    mask = np.zeros(gdf.scene.count, bool)
    mask[gdf.region.members.numpy()] = True
    return EditRef(file.file, file.sha256, gdf.region.name, pack(mask))


def open_session(path: Path) -> WindowSession:
    """Read a session with its scene and edits; what is to be said about it is logged as a warning.

    Raises:
        ProgdfError: it is no session, damaged or of a newer version; or a file it names is missing, broken or
            not the one it was saved with.
    """
    file = read_session(path, WindowFile)
    scene, gdfs = verify_files(path, file)

    def place(scene: Gaussians, index: int, name: str) -> Region | None:
        edit = file.edits[index]
        if not edit.members:
            return None
        return from_mask(edit.region, torch.from_numpy(unpack(edit.members, len(scene)).copy()))

    opened = document.load(scene, gdfs, place)
    x, y, z = opened.scene.origin
    view, snapshots = _move(file.view, file.snapshots, (-x, -y, -z))
    check_selection(view.selection, len(opened.scene))
    named = view.selection.regions
    folder = path.resolve().parent
    view = _with_region_paths(view, lambda region: Path(os.path.normpath(folder / region)))
    for layer in (*view.layers, *(layer for s in snapshots for layer in s.edit.layers)):
        gdf = opened.gdfs[layer.gdf]
        paint.decode(layer.paint, len(gdf.region), gdf.from_others)  # raises where they do not fit
    claimed = exports.claim_regions(view.selection, exports.region_folders(path, scene))
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
    moved = tuple(replace(snapshot, camera=move_camera(snapshot.camera, by)) for snapshot in snapshots)
    timeline = _move_keys(view.timeline, by)
    return replace(view, camera=move_camera(view.camera, by), timeline=timeline), moved


def _move_keys(timeline: Timeline, by: Vec3) -> Timeline:
    """The same film of a scene that lies elsewhere; see `move_camera`."""
    return replace(
        timeline,
        keys=tuple(
            replace(key, camera=None if key.camera is None else move_camera(key.camera, by))
            for key in timeline.keys
        ),
    )


def _check_keys(timeline: Timeline, where: str) -> None:
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


def _with_region_paths(view: ViewState, change: Callable[[Path], Path]) -> ViewState:
    regions = tuple(replace(region, path=change(region.path)) for region in view.selection.regions)
    return replace(view, selection=replace(view.selection, regions=regions))


def default_path(opened: Document) -> Path:
    """What a session of it is called if nobody says otherwise: as the scene, and beside it."""
    scene = opened.path or Path(opened.title)
    return scene.with_name(scene.stem + SUFFIX)


def prune(session: WindowSession) -> WindowSession:
    """Without the edits that no layer shows any more, in the view or in a snapshot."""
    view = session.view
    snapshots = session.snapshots
    stacks = (view.layers, *(s.edit.layers for s in snapshots))
    used = sorted({layer.gdf for layers in stacks for layer in layers})
    places = {gdf: i for i, gdf in enumerate(used)}

    opened = session.document
    rows = np.arange(len(opened.scene))

    def renumber(layers: tuple[LayerState, ...]) -> tuple[LayerState, ...]:
        return tuple(replace(layer, gdf=places[layer.gdf], paint=paint_left(layer)) for layer in layers)

    def paint_left(layer: LayerState) -> str:
        """Of an edit of all that is there, the paint of the rows that are left."""
        gdf = opened.gdfs[layer.gdf]
        weights = paint.decode(layer.paint, len(gdf.region), gdf.from_others)
        whole = weights is not None and len(weights) == len(opened.scene) > len(rows)
        return paint.encode(weights[rows].numpy()) if whole and weights is not None else layer.paint

    if opened.scene is not opened.original:  # masks of the rows that the file's own edits bring
        added = [opened.gdfs[gdf] for gdf in used if opened.edits[gdf].added is not None]
        count = len(opened.original)
        members = [gdf.region.members.numpy() for gdf in added]
        rows = np.concatenate([np.arange(count), *(own[own >= count] for own in members)])
        view = replace(view, selection=take_rows(view.selection, len(opened.scene), rows))
        session = replace(session, view=view)
    if len(used) == len(opened.edits):
        return session
    keys = tuple(
        replace(key, strengths=tuple((places[gdf], s) for gdf, s in key.strengths if gdf in places))
        for key in view.timeline.keys
    )
    return WindowSession(
        replace(
            opened,
            edits=tuple(opened.edits[gdf] for gdf in used),
            gdf_paths=tuple(opened.gdf_paths[gdf] for gdf in used),
        ),
        replace(
            view,
            layers=renumber(view.layers),
            timeline=replace(view.timeline, keys=keys),
            unfolded=tuple(places[gdf] for gdf in view.unfolded if gdf in places),
        ),
        tuple(replace(s, edit=replace(s.edit, layers=renumber(s.edit.layers))) for s in snapshots),
    )


def session_file(path: Path) -> Path:
    """A path as a session's file is called.

    Raises:
        ProgdfError: it has no name.
    """
    if not path.name:
        raise ProgdfError(f"{path} is a folder; add the name of the session")
    return path if path.suffix == ".json" else path.with_name(path.name + SUFFIX)


class SessionAutosave:
    """The autosave of one window, which never writes over another's."""

    def __init__(self) -> None:
        self.path: Path | None = None
        """Its file; None before there is one."""
        self._due: float | None = None
        self._work: object = None  # what the file holds

    def wait(
        self, now: float, work: object, beside: Callable[[], Path], save: Callable[[Path], None]
    ) -> float:
        """Write unsaved work once it is old enough; 0 where it was written, or is already.

        Args:
            now: seconds of any clock that does not go back
            work: the work
            beside: gives the session's file
            save: writes the work into a file; what it raises is the caller's

        Returns:
            Seconds until it is time.
        """
        if work == self._work:
            self._due = None
            return 0.0
        if self._due is None:
            self._due = now + AUTOSAVE_S
        if now < self._due:
            return self._due - now
        self.write(work, beside, save)
        return 0.0

    def write(self, work: object, beside: Callable[[], Path], save: Callable[[Path], None]) -> Path:
        """Write it at once; the file. Arguments as of `wait`."""
        self._due = None
        self._work = work
        if self.path is None:
            self.path = next(path for path in _numbered_paths(beside(), "autosave") if not path.exists())
        save(self.path)
        return self.path

    def stop(self) -> None:
        """There is nothing unsaved."""
        self._due = None

    def continue_from(self, path: Path) -> None:
        """The work of an autosave was opened: the file is this window's from now on."""
        self.path = path
        self._due = None
        self._work = None

    def drop(self) -> None:
        """Delete the file: its work is saved."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
        self.path = None
        self._due = None
        self._work = None

    def discard(self) -> Path | None:
        """Put the file aside; where it went, None where there is none."""
        path = self.path
        self.path = None
        self._due = None
        self._work = None
        return put_aside(path) if path is not None and path.exists() else None


def session_of(path: Path) -> Path | None:
    """The session whose work an autosave, or discarded work, holds; None where `path` is neither."""
    match = re.fullmatch(rf"(.+)\.({'|'.join(_KINDS)})(-\d+)?{re.escape(SUFFIX)}", path.name)
    return path.with_name(match[1] + SUFFIX) if match else None


def is_discarded(path: Path) -> bool:
    """Whether it is work that was discarded, by its name."""
    return ".discarded" in path.name and session_of(path) is not None


def find_autosaves(session: Path, numbered: bool = False) -> tuple[Path, ...]:
    """Autosaves that lie beside a session, the latest first.

    Args:
        session: its file, which need not exist
        numbered: also those of NAME-2, NAME-3 …, as sessions of one scene are called
    """
    pattern = re.escape(stem(session)) + (r"(-\d+)?" if numbered else "")
    pattern += rf"\.autosave(-\d+)?{re.escape(SUFFIX)}"
    try:
        paths = [path for path in session.parent.iterdir() if re.fullmatch(pattern, path.name)]
        return tuple(sorted(paths, key=lambda path: path.stat().st_mtime, reverse=True))
    except OSError:
        return ()


def put_aside(path: Path) -> Path:
    """An autosave as discarded work, in the place of the oldest where there are `MAX_DISCARDED`.

    Raises:
        OSError: it cannot be moved.
    """
    session = session_of(path) or path
    names = [
        name for name, _ in zip(_numbered_paths(session, "discarded"), range(MAX_DISCARDED), strict=False)
    ]
    free = [name for name in names if not name.exists()]
    to = free[0] if free else min(names, key=lambda name: name.stat().st_mtime)
    replace_file(path, to)
    os.utime(to)  # the age that counts is since when it is discarded
    return to


def free_session(path: Path, autosave: Path | None) -> Path:
    """`path`, with a number where such a session exists, or unsaved work of it that is not `autosave`."""

    def taken(session: Path) -> bool:
        return session.exists() or any(other != autosave for other in find_autosaves(session))

    return next(session for session in _numbered_paths(path) if not taken(session))


def stem(session: Path) -> str:
    """A session's name without its endings."""
    return session.name.removesuffix(SUFFIX) if session.name.endswith(SUFFIX) else session.stem


def _numbered_paths(session: Path, kind: str = "") -> Iterator[Path]:
    """NAME, NAME-2, NAME-3 …; with a kind NAME.kind, NAME.kind-2 …"""
    names = numbered_names(stem(session) + f".{kind}" * bool(kind), SUFFIX)
    return map(session.with_name, names)
