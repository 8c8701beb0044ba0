"""Sessions: saving and opening the state of the window, and autosaves of unsaved work beside the session.

- bear.session.json: the session, a `WindowFile`; also the default name for a scene without a session
- bear.autosave.session.json: its unsaved work; -2, -3 … if earlier autosaves still await a decision
- bear.discarded.session.json: the last `MAX_DISCARDED` pieces of discarded work
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from progdf.compose import layer_paint
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.placed import Placement
from progdf.io.atomic import (
    LockedError,
    hold_lock,
    is_locked,
    make_folder,
    numbered_names,
    state_folder,
)
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
from progdf.painting.strokes import unpack
from progdf.region import Region, from_mask
from progdf.system.files import replace_file
from progdf.terminal import escape_text
from viewer.camera.view_camera import Vec3, move_camera
from viewer.state import selection
from viewer.state.layers import tidy_groups
from viewer.state.snapshots import SliderSnapshot
from viewer.state.timeline import split_keys
from viewer.state.view_state import LayerState, Timeline, ViewState

from . import document, region_files, scenes
from .document import Document

_log = logging.getLogger(__name__)


AUTOSAVE_S = 20.0
"""Time from a change to its autosave, in seconds."""

MAX_DISCARDED = 3  # files of discarded work per session
_KINDS = "autosave", "discarded"  # name parts of files that belong to a session


@dataclass(frozen=True)
class WindowSession:
    """Content of a session."""

    document: Document
    view: ViewState
    snapshots: tuple[SliderSnapshot, ...] = ()
    warning: str = ""  # one line about values that were changed on opening


class WindowFile(SessionFile, frozen=True, forbid_unknown_fields=True):
    """Schema of the file: references to the scene and the edits, and the state of the window."""

    view: ViewState = ViewState()  # type: ignore[assignment]
    snapshots: tuple[SliderSnapshot, ...] = ()  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Validate the state. Raises ValueError for values that the window cannot produce."""
        _check_keys(self.view.timeline, "view.timeline.keys")
        stacks = {"view": self.view.layers}
        stacks |= {f"snapshots[{i}].edit": snapshot.edit.layers for i, snapshot in enumerate(self.snapshots)}
        for where, layers in stacks.items():
            for i, layer in enumerate(layers):
                if not 0 <= layer.gdf < len(self.edits):
                    raise ValueError(
                        f"{where}.layers[{i}].gdf is {layer.gdf}, but there are {len(self.edits)} edits"
                    )
        listed = [state.scene for state in self.view.scenes] or [0]
        if sorted(listed) != list(range(1 + len(self.added))):
            raise ValueError(f"view.scenes lists {listed}, but there are {1 + len(self.added)} scenes")
        for i, edit in enumerate(self.edits):
            if not 0 <= edit.scene <= len(self.added):
                raise ValueError(
                    f"edits[{i}].scene is {edit.scene}, but there are {1 + len(self.added)} scenes"
                )


def save(path: Path, session: WindowSession) -> None:
    """Write the session atomically.

    Raises:
        ProgdfError: the scene or an edit has no file, a file cannot be read, or the folder does not exist.
    """
    if session.document.path is None or len(session.document.gdf_paths) != len(session.document.edits):
        raise ProgdfError(f"{session.document.title} was not opened from files; save the scene first")
    session = prune(session)
    scene = session.document.path
    assert scene is not None
    view, snapshots = _move(session.view, session.snapshots, session.document.scene.origin)
    if not path.parent.is_dir():
        raise ProgdfError(f"the folder {path.parent} does not exist; create it first")
    folder = path.parent
    view = _with_region_paths(view, lambda region: Path(relative_name(region, folder)))
    opened = session.document
    edits = tuple(
        _edit_ref(gdf, path, folder, opened.owner(i))
        for i, (gdf, path) in enumerate(zip(opened.edits, opened.gdf_paths, strict=True))
    )
    added = tuple(reference(file.path, folder) for file in opened.files[1:] if file.path is not None)
    write_session(path, WindowFile(reference(scene, folder), edits, view, snapshots, added))


def _edit_ref(gdf: Gdf, path: Path, folder: Path, scene: int) -> EditRef:
    file = reference(path, folder)
    if not gdf.applied:
        return EditRef(file.file, file.sha256, scene)
    mask = np.zeros(gdf.scene.count, bool)
    mask[gdf.region.members.numpy()] = True
    return EditRef(file.file, file.sha256, scene, gdf.region.name, selection.pack(mask))


def open_session(path: Path) -> WindowSession:
    """Open a session with its scene and edits, and log its warning.

    Raises:
        ProgdfError: the file is not a session, damaged or of a newer version, or a file that it refers to is
            missing, damaged or not the one it was saved with.
    """
    file = read_session(path, WindowFile)
    files, gdfs = verify_files(path, file)
    owners = tuple(edit.scene for edit in file.edits)

    def place(scene: Gaussians, index: int, name: str) -> Region | None:
        edit = file.edits[index]
        if not edit.members:
            return None
        return from_mask(edit.region, torch.from_numpy(selection.unpack(edit.members, len(scene)).copy()))

    opened = document.load_stack([*map(document.load_file, files)], gdfs, place, owners)
    opened = opened.arrange(file.view.scenes)
    x, y, z = opened.scene.origin
    view, snapshots = _move(file.view, file.snapshots, (-x, -y, -z))
    selection.check(view.selection, len(opened.scene))
    for picture in view.painted:
        unpack(picture.pixels, *picture.size, picture.box)  # raises if it is damaged
    named = view.selection.regions
    folder = path.resolve().parent
    view = _with_region_paths(view, lambda region: Path(os.path.normpath(folder / region)))
    for layer in (*view.layers, *(layer for s in snapshots for layer in s.edit.layers)):
        gdf = opened.gdfs[layer.gdf]
        layer_paint.decode(layer.paint, len(gdf.region), gdf.from_others)  # raises if the weights do not fit
    claimed = region_files.claim_regions(view.selection, region_files.region_folders(path, files[0]))
    moved = [
        f"{old.name:.60} ({str(old.path)[:80]})"
        for old, resolved, new in zip(named, view.selection.regions, claimed.regions, strict=True)
        if new.path != resolved.path
    ]
    # no tool is active after opening
    view = replace(
        view,
        selection=claimed,
        brush=replace(view.brush, active=False),
        color_brush=replace(view.color_brush, tool=""),
        select=replace(view.select, tool=""),
    )
    warning = ""
    if moved:
        more = f" and {len(moved) - 1} more" if len(moved) > 1 else ""
        warning = escape_text(
            f"{path.name}: invalid path of region {moved[0]}{more}, not a {selection.SUFFIX} file "
            "in the session's folder; save the session to write it there"
        )
        _log.warning(warning)
    return WindowSession(opened, view, snapshots, warning)


def _move(
    view: ViewState, snapshots: tuple[SliderSnapshot, ...], by: Vec3
) -> tuple[ViewState, tuple[SliderSnapshot, ...]]:
    """Translate all cameras by `by`. Sessions store cameras in world coordinates."""
    moved = tuple(replace(snapshot, camera=move_camera(snapshot.camera, by)) for snapshot in snapshots)
    timeline = _move_keys(view.timeline, by)
    painted = tuple(replace(one, camera=move_camera(one.camera, by)) for one in view.painted)
    camera = move_camera(view.camera, by)
    return replace(view, camera=camera, timeline=timeline, painted=painted), moved


def _move_keys(timeline: Timeline, by: Vec3) -> Timeline:
    """Translate the cameras of a timeline, see `move_camera`."""
    return replace(
        timeline,
        keys=tuple(
            replace(key, camera=None if key.camera is None else move_camera(key.camera, by))
            for key in timeline.keys
        ),
    )


def _check_keys(timeline: Timeline, where: str) -> None:
    """Validate the keys of a timeline.

    Raises:
        ValueError: keys contradict each other or exceed the length; the message names the key.
    """
    for i, key in enumerate(timeline.keys):
        if key.frame > timeline.length:
            raise ValueError(f"{where}[{i}].frame is {key.frame}, outside 0 to the length, {timeline.length}")
        if key.camera is not None and not any(key.camera.up):
            raise ValueError(f"{where}[{i}].camera has an up axis without a direction")
    rows = [row for key in timeline.keys for row in split_keys(Timeline((key,))) or [(None, key.frame)]]
    if len(set(rows)) < len(rows) or any(a.frame > b.frame for a, b in pairwise(timeline.keys)):
        raise ValueError(f"{where} has two keys of one row at one frame, or keys out of order")


def _with_region_paths(view: ViewState, change: Callable[[Path], Path]) -> ViewState:
    regions = tuple(replace(region, path=change(region.path)) for region in view.selection.regions)
    return replace(view, selection=replace(view.selection, regions=regions))


def default_path(opened: Document) -> Path:
    """Return the default path of a session: the scene's name, beside the scene."""
    scene = opened.path or Path(opened.title)
    return scene.with_name(scene.stem + SUFFIX)


def prune(session: WindowSession) -> WindowSession:
    """Remove the edits that no layer of the view or of a snapshot uses, and unlisted scenes."""
    return _drop_scenes(_drop_edits(_without_layers(session)))


def _drop_edits(session: WindowSession) -> WindowSession:
    """Remove the edits that no layer of the view or of a snapshot uses."""
    view = session.view
    snapshots = session.snapshots
    stacks = (view.layers, *(s.edit.layers for s in snapshots))
    used = sorted({layer.gdf for layers in stacks for layer in layers})
    new_index = {gdf: i for i, gdf in enumerate(used)}

    opened = session.document
    rows = np.arange(len(opened.scene))

    def renumber(layers: tuple[LayerState, ...]) -> tuple[LayerState, ...]:
        return tuple(replace(layer, gdf=new_index[layer.gdf], paint=paint_left(layer)) for layer in layers)

    def paint_left(layer: LayerState) -> str:
        """Return the paint, limited to the remaining rows if the edit covers the whole scene."""
        gdf = opened.gdfs[layer.gdf]
        weights = layer_paint.decode(layer.paint, len(gdf.region), gdf.from_others)
        whole = weights is not None and len(weights) == len(opened.scene) > len(rows)
        return layer_paint.encode(weights[rows].numpy()) if whole and weights is not None else layer.paint

    if opened.scene is not opened.original:  # convert masks to the rows of the remaining edits
        added = [opened.gdfs[gdf] for gdf in used if opened.edits[gdf].added is not None]
        count = len(opened.original)
        members = [gdf.region.members.numpy() for gdf in added]
        rows = np.concatenate([np.arange(count), *(own[own >= count] for own in members)])
        view = replace(view, selection=selection.take_rows(view.selection, len(opened.scene), rows))
        session = replace(session, view=view)
    if len(used) == len(opened.edits):
        return session
    keys = tuple(
        replace(key, strengths=tuple((new_index[gdf], s) for gdf, s in key.strengths if gdf in new_index))
        for key in view.timeline.keys
    )
    return WindowSession(
        replace(
            opened,
            edits=tuple(opened.edits[gdf] for gdf in used),
            gdf_paths=tuple(opened.gdf_paths[gdf] for gdf in used),
            owners=tuple(opened.owner(gdf) for gdf in used) if opened.owners else (),
        ),
        replace(
            view,
            layers=renumber(view.layers),
            timeline=replace(view.timeline, keys=keys),
            unfolded=tuple(new_index[gdf] for gdf in view.unfolded if gdf in new_index),
        ),
        tuple(replace(s, edit=replace(s.edit, layers=renumber(s.edit.layers))) for s in snapshots),
    )


def visible_only(session: WindowSession) -> WindowSession:
    """Return the session without hidden scenes and their layers.

    Raises:
        ProgdfError: all scenes are hidden.
    """
    shown = tuple(state for state in session.view.scenes if state.visible)
    if shown == session.view.scenes:
        return session
    if not shown:
        raise ProgdfError("all scenes are hidden; show one first")
    return prune(replace(session, view=replace(session.view, scenes=shown)))


def _without_layers(session: WindowSession) -> WindowSession:
    """Remove the layers of scenes that the view does not list."""
    opened = session.document
    listed = {state.scene for state in session.view.scenes} or {0}
    if len(listed) == len(opened.scene_files):
        return session

    def keep(layers: tuple[LayerState, ...]) -> tuple[LayerState, ...]:
        return tuple(layer for layer in layers if opened.owner(layer.gdf) in listed)

    view = tidy_groups(replace(session.view, layers=keep(session.view.layers)))
    snapshots = tuple(replace(s, edit=replace(s.edit, layers=keep(s.edit.layers))) for s in session.snapshots)
    return replace(session, view=view, snapshots=snapshots)


def _drop_scenes(session: WindowSession) -> WindowSession:
    """Remove the scenes that the view does not list, and number the others again."""
    opened = session.document
    states = session.view.scenes or scenes.first_states(opened.scene_files[0].title)
    kept = sorted(state.scene for state in states)
    if len(kept) == len(opened.scene_files):
        return session
    stays = np.ones(len(opened.scene), bool)
    for scene in range(len(opened.files)):
        stays[scenes.rows_of(opened.files, scene)] = scene in kept
    masks = selection.take_rows(session.view.selection, len(opened.scene), np.flatnonzero(stays))
    states = tuple(replace(state, scene=kept.index(state.scene)) for state in states)
    first, *others = (opened.files[scene] for scene in kept)
    if not others and states[0].visible and states[0].placement == Placement():
        states = ()
    remaining = Document(first.title, first.gaussians, opened.edits, first.path, opened.gdf_paths)
    remaining = replace(
        remaining, owners=tuple(kept.index(opened.owner(i)) for i in range(len(opened.edits)))
    )
    return replace(
        session,
        document=remaining.with_scenes(*others).arrange(states),
        view=replace(session.view, scenes=states, selection=masks),
    )


def session_file(path: Path) -> Path:
    """Return the path with the suffix of a session, unless it ends in .json.

    Raises:
        ProgdfError: the path has no name.
    """
    if not path.name:
        raise ProgdfError(f"{path} is a folder; add the name of the session")
    return path if path.suffix == ".json" else path.with_name(path.name + SUFFIX)


class Claim:
    """Lock on a session or autosave while a window has it open. The system releases it after a crash."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._held = ExitStack()

    def take(self, path: Path) -> bool:
        """Lock a file that need not exist, instead of the earlier one; return False if a window has it."""
        if path == self._path:
            return True
        self.release()
        try:
            make_folder(_lock_file(path).parent)
            self._held.enter_context(hold_lock(_lock_file(path)))
        except LockedError:
            return False
        except (ProgdfError, OSError):  # without a writable state folder, nothing is locked
            return True
        self._path = path
        return True

    def release(self) -> None:
        """Release the lock."""
        self._held.close()
        self._path = None


def is_claimed(path: Path) -> bool:
    """Return whether a running window has a session or autosave open."""
    return is_locked(_lock_file(path))


def _lock_file(path: Path) -> Path:
    """Return the lock file of a session or autosave, outside its folder, which may be shared or read-only."""
    digest = hashlib.sha256(os.fsencode(path.resolve())).hexdigest()[:16]
    return state_folder() / "open" / f"{digest}.lock"


class SessionAutosave:
    """Autosave of one window. It never overwrites the autosave of another window."""

    def __init__(self) -> None:
        self.path: Path | None = None
        """Path of its file, None before the first autosave."""
        self._claim = Claim()
        self._due: float | None = None  # time of the next autosave
        self._work: object = None  # content of the file

    def wait(
        self, now: float, work: object, beside: Callable[[], Path], save: Callable[[Path], None]
    ) -> float:
        """Write unsaved work `AUTOSAVE_S` seconds after it changed.

        Args:
            now: seconds of a monotonic clock
            work: the current work
            beside: returns the session's path
            save: writes the work to a file; its errors propagate

        Returns:
            Seconds until the next write, or 0 if the work is written.
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
        """Write the work at once and return the path. The arguments are those of `wait`."""
        self._due = None
        self._work = work
        if self.path is None:
            self.path = next(path for path in _numbered_paths(beside(), "autosave") if not path.exists())
            self._claim.take(self.path)
        save(self.path)
        return self.path

    def stop(self) -> None:
        """Cancel the pending autosave, as nothing is unsaved."""
        self._due = None

    def continue_from(self, path: Path) -> None:
        """Take over the file of an opened autosave."""
        self.path = path
        self._claim.take(path)
        self._due = None
        self._work = None

    def drop(self) -> None:
        """Delete the file, as its work is saved."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
        self.release()
        self.path = None
        self._due = None
        self._work = None

    def discard(self) -> Path | None:
        """Move the file to discarded work. Return its new path, or None if there is no file."""
        path = self.path
        self.release()
        self.path = None
        self._due = None
        self._work = None
        return put_aside(path) if path is not None and path.exists() else None

    def release(self) -> None:
        """Release the lock of the file, so that another window offers to restore it."""
        self._claim.release()


def session_of(path: Path) -> Path | None:
    """Return the session that an autosave or discarded work belongs to, or None if `path` is neither."""
    match = re.fullmatch(rf"(.+)\.({'|'.join(_KINDS)})(-\d+)?{re.escape(SUFFIX)}", path.name)
    return path.with_name(match[1] + SUFFIX) if match else None


def is_discarded(path: Path) -> bool:
    """Return whether the file's name marks it as discarded work."""
    return ".discarded" in path.name and session_of(path) is not None


def find_autosaves(session: Path, numbered: bool = False) -> tuple[Path, ...]:
    """Find the autosaves beside a session, the latest first.

    Args:
        session: path of the session, which need not exist
        numbered: also find autosaves of NAME-2, NAME-3 …, further sessions of the same scene
    """
    pattern = re.escape(stem(session)) + (r"(-\d+)?" if numbered else "")
    pattern += rf"\.autosave(-\d+)?{re.escape(SUFFIX)}"
    try:
        paths = [path for path in session.parent.iterdir() if re.fullmatch(pattern, path.name)]
        return tuple(sorted(paths, key=lambda path: path.stat().st_mtime, reverse=True))
    except OSError:
        return ()


def put_aside(path: Path) -> Path:
    """Move an autosave to discarded work. The oldest is replaced if there are `MAX_DISCARDED`.

    Raises:
        OSError: the file cannot be moved.
    """
    session = session_of(path) or path
    names = [
        name for name, _ in zip(_numbered_paths(session, "discarded"), range(MAX_DISCARDED), strict=False)
    ]
    free = [name for name in names if not name.exists()]
    to = free[0] if free else min(names, key=lambda name: name.stat().st_mtime)
    replace_file(path, to)
    os.utime(to)  # its age counts from the time of discarding
    return to


def free_session(path: Path, autosave: Path | None) -> Path:
    """Return `path`, with a number if that session exists or has an autosave other than `autosave`."""

    def taken(session: Path) -> bool:
        return session.exists() or any(other != autosave for other in find_autosaves(session))

    return next(session for session in _numbered_paths(path) if not taken(session))


def stem(session: Path) -> str:
    """Return the name of a session without its suffixes."""
    return session.name.removesuffix(SUFFIX) if session.name.endswith(SUFFIX) else session.stem


def _numbered_paths(session: Path, kind: str = "") -> Iterator[Path]:
    """Yield NAME, NAME-2, NAME-3 …; with a kind NAME.kind, NAME.kind-2 …"""
    name = f"{stem(session)}.{kind}" if kind else stem(session)
    return map(session.with_name, numbered_names(name, SUFFIX))
