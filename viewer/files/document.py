"""Document: the open scene and its edits, with their files."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.compose.added import extend
from progdf.errors import ProgdfError
from progdf.formats.ply_view import stored_view
from progdf.formats.scene_file import load_scene, scene_file, scene_name
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, fingerprint, load_gdf, read_gdf
from progdf.io.atomic import numbered_names
from progdf.region import Region
from progdf.scene.neighbors import Neighborhood
from progdf.terminal import escape_text
from progdf.threads import all_threads
from viewer.camera.view_camera import Bounds, SceneUp, bounds_of, find_scene_up, first_camera, fit, fit_all
from viewer.state.facts import layer_rows
from viewer.state.view_state import LayerState, SceneState
from viewer.state.workspace import SceneFacts

from . import scenes
from .scenes import OwnScene, SceneFile

_Value = TypeVar("_Value")

RegionChooser = Callable[[Gaussians, int, str], Region | None]
"""Function from a scene, an edit's index and its name to the region that the edit's grade is applied to.

It returns None if the edit keeps its own region.
"""


def _own_region(_: Gaussians, index: int, name: str) -> Region | None:
    return None


@dataclass(frozen=True)
class Document:
    """Scene and its edits, indexed by `LayerState.gdf`; or several scenes, merged (see `scenes`)."""

    title: str  # name of the scene; "" if none is open
    original: Gaussians  # scene as in its file, or the merged scenes
    edits: tuple[Gdf, ...] = ()  # edits as in their files, each of its own scene
    path: Path | None = None  # file of the first scene; without one, no session can be saved
    gdf_paths: tuple[Path, ...] = ()  # files of the edits, either none or one per edit
    files: tuple[
        SceneFile, ...
    ] = ()  # all scenes that were opened, indexed by `SceneState.scene`; empty: one
    states: tuple[SceneState, ...] = ()  # scenes of the view from which `original` was merged
    owners: tuple[int, ...] = ()  # scene of each edit; missing ones: the first scene
    live: tuple[Gdf, ...] = ()  # edits of `original` in training or preview, after the others

    @cached_property
    def placed_edits(self) -> tuple[Gdf, ...]:
        """Edits as edits of `original`."""
        return tuple(self.place(gdf, self.owner(i)) for i, gdf in enumerate(self.edits))

    @cached_property
    def _extension(self) -> tuple[Gaussians, tuple[Gdf, ...]]:
        scene, gdfs = extend(self.original, (*self.placed_edits, *self.live))
        hidden = [
            gdf for i, gdf in enumerate(gdfs[: len(self.edits)]) if not self._state(self.owner(i)).visible
        ]
        rows = [gdf.region.members[gdf.region.members >= len(self.original)] for gdf in hidden]
        if any(map(len, rows)):
            logits = scene.logit_opacities.index_fill(0, torch.cat(rows), scenes.HIDDEN_LOGIT)
            scene = replace(scene, logit_opacities=logits)
        return scene, gdfs

    def _state(self, scene: int) -> SceneState:
        return scenes.state_of(self.states, scene)

    @property
    def scene_files(self) -> tuple[SceneFile, ...]:
        """All scenes that were opened."""
        return self.files or (SceneFile(self.title, self.original, self.path),)

    def owner(self, edit: int) -> int:
        """Return the scene of an edit."""
        return self.owners[edit] if edit < len(self.owners) else 0

    def place(self, gdf: Gdf, scene: int) -> Gdf:
        """Return an edit of a scene as an edit of `original`."""
        if not self.files:
            return gdf
        return scenes.placed_edit(gdf, self.files, scene, self._state(scene).placement, self.original)

    def own(self, gdf: Gdf) -> tuple[Gdf, int]:
        """Return an edit of `original` as an edit of its scene, and that scene.

        Raises:
            ProgdfError: it changes several scenes.
        """
        if not self.files:
            return gdf, 0
        scene = self.scene_with(gdf.region.members)
        return scenes.own_edit(gdf, self.files, scene, self._state(scene).placement), scene

    def scene_with(self, rows: Tensor) -> int:
        """Return the scene that holds some rows of `original`; without rows, the only visible scene.

        Raises:
            ProgdfError: there are several.
        """
        if not self.files:
            return 0
        found = [state.scene for state in self.states if state.visible]
        if len(rows):
            bounds = [scenes.rows_of(self.files, i) for i in range(len(self.files))]
            found = [
                i for i, own in enumerate(bounds) if bool(((rows >= own.start) & (rows < own.stop)).any())
            ]
        if len(found) != 1:
            raise ProgdfError(
                "an edit belongs to one scene; select Gaussians of one scene, or hide the other scenes"
            )
        return found[0]

    def own_scene(self, scene: int) -> OwnScene:
        """Return a scene with its own rows and coordinates, as a run trains on it."""
        file = self.scene_files[scene]
        rows = scenes.rows_of(self.scene_files, scene)
        return OwnScene(file, rows, self._state(scene).placement, self.original.origin)

    def only_scene(self) -> OwnScene:
        """Return the only visible scene.

        Raises:
            ProgdfError: there are several.
        """
        return self.own_scene(self.scene_with(torch.zeros(0, dtype=torch.int64)))

    def scene_at(self, path: Path) -> int:
        """Return the first scene with this file, or the first scene."""
        for scene, file in enumerate(self.scene_files):
            if file.path is not None and file.path.resolve() == path.resolve():
                return scene
        return 0

    def file_at(self, path: Path) -> SceneFile:
        """Return the first scene with this file, or the first scene."""
        return self.scene_files[self.scene_at(path)]

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of Gaussians of each scene."""
        return tuple(len(file.gaussians) for file in self.scene_files)

    def with_scenes(self, *added: SceneFile) -> Document:
        """Return the document with further scenes, which stay hidden until a view lists them."""
        if not added:
            return self
        states = self.states or scenes.first_states(self.title)
        return replace(self, files=(*self.scene_files, *added), states=states)._merge()

    def arrange(self, states: tuple[SceneState, ...]) -> Document:
        """Return the document with the scenes as a view lists them; the same object if nothing changes."""
        if states == self.states:
            return self
        if not self.files:
            return replace(self, files=self.scene_files).arrange(states)
        is_same = [(s.scene, s.visible, s.placement) for s in states] == [
            (s.scene, s.visible, s.placement) for s in self.states
        ]
        first = self.files[states[0].scene if states else 0]
        changed = replace(self, states=states, title=first.title, path=first.path)
        return changed if is_same else changed._merge()

    def _merge(self) -> Document:
        return replace(self, original=scenes.merge(self.files, self.states))

    @property
    def framed_scene(self) -> Gaussians:
        """Visible scenes with about equally many Gaussians each, so that a view frames all of them."""
        visible = [state.scene for state in self.states if state.visible]
        if not self.files or not visible:
            return self.original
        fewest = min(self.counts[scene] for scene in visible)
        rows = []
        for scene in visible:
            own = scenes.rows_of(self.files, scene)
            rows.append(torch.arange(own.start, own.stop, -(-self.counts[scene] // fewest)))
        return self.original[torch.cat(rows)]

    @property
    def hidden(self) -> Tensor:
        """Rows of the original that belong to hidden scenes. [N] bool"""
        if not self.files:
            return torch.zeros(len(self.original), dtype=torch.bool)
        return scenes.hidden_rows(self.files, self.states)

    @property
    def scene(self) -> Gaussians:
        """Original with the rows added by edits, as drawn with all sliders at 0."""
        return self._extension[0]

    @property
    def gdfs(self) -> tuple[Gdf, ...]:
        """Edits, extended to the rows of `scene`."""
        return self._extension[1]

    @cached_property
    def detected_up(self) -> SceneUp:
        """Up axis found from the first scene and its edits."""
        edits = [gdf for i, gdf in enumerate(self.edits) if self.owner(i) == 0]
        return find_scene_up(self.scene_files[0].gaussians, edits, path=self.path)

    @cached_property
    def bounds(self) -> Bounds:
        """Bounds of the bulk of the visible scenes."""
        return bounds_of(self.framed_scene)

    @cached_property
    def stored_camera(self) -> Camera | None:
        """Camera stored in the scene's file, which defines the first view."""
        return None if self.path is None else stored_view(self.path, self.original.origin).camera

    def facts(self) -> SceneFacts:
        """Compute the facts for the panel and the camera."""
        scene = self.scene
        added = [gdf.members - len(gdf.region) for gdf in (*self.edits, *self.live)]
        shown = self.framed_scene
        neighborhood = _once(lambda: Neighborhood(scene))
        return SceneFacts(
            title=self.title,
            count=len(scene),
            added=len(scene) - len(self.original),
            bounds=self.bounds,
            origin=scene.origin,
            scene_counts=self.counts,
            rows=layer_rows(scene, self.gdfs, added),
            fit=lambda camera, aspect: fit_all(camera, shown, aspect),
            fit_members=lambda camera, aspect, mask: fit(camera, scene[torch.tensor(mask)], aspect),
            neighborhood=neighborhood,
            scribbles=_once(lambda: neighborhood().scribbles),
            home=lambda camera, aspect: replace(
                first_camera(shown, (), aspect, camera.fov_y, camera.up, stored=self.stored_camera),
                mode=camera.mode,
            ),
        )

    @property
    def is_empty(self) -> bool:
        """True if no scene is open, so that the start page is visible."""
        return not self.title

    @property
    def file(self) -> Path:
        """File of the scene. Raises ProgdfError if there is none."""
        if self.path is None:
            raise ProgdfError("the scene has no file yet; open one first")
        return self.path

    def edit_of(self, path: Path) -> Gdf | None:
        """Return the edit with this file; None if there is none."""
        files = [file.resolve() for file in self.gdf_paths]
        path = path.resolve()
        return self.edits[files.index(path)] if path in files else None

    def free_name(self, name: str) -> str:
        """Return `name`, with a number if another edit has it."""
        return _free_name(name, self.edits)


LiveLayers = tuple[LayerState, ...]
"""Layers of the edits in training, on top of the document's."""


class DocumentStore:
    """Holder of the open document. The parts of the window read and replace it only here.

    Args:
        document: the first document
        draw: draws a document with its live edits and their layers from now on; if it raises, the document
            stays
    """

    def __init__(
        self, document: Document, draw: Callable[[Document, tuple[Gdf, ...], LiveLayers], None]
    ) -> None:
        self._document = document
        self._draw = draw

    def get(self) -> Document:
        """Return the open document."""
        return self._document

    def replace(self, document: Document, live: tuple[Gdf, ...] = (), layers: LiveLayers = ()) -> None:
        """Set and draw the document from now on. The caller updates the state.

        Args:
            document: the new document, often with the same scene and other edits
            live: edits in training or preview
            layers: layers that show these edits on top
        """
        self._draw(document, live, layers)
        self._document = document


def _once(make: Callable[[], _Value]) -> Callable[[], _Value]:
    """Return a thread-safe function that calls `make` once, on first use. Concurrent callers wait."""
    lock = threading.Lock()
    cached = cache(make)

    def ask() -> _Value:
        with lock:
            return cached()

    return ask


def empty() -> Document:
    """Return an empty document: one invisible Gaussian and no title."""
    row = torch.zeros(1, 3)
    no_sh = row[:, None, :][:, :0]
    logit = torch.tensor([-20.0])
    return Document("", Gaussians(row, torch.eye(4)[:1], row - 5.0, logit, row, no_sh))


def load(scene: Path, gdfs: Sequence[Path] = (), place: RegionChooser = _own_region) -> Document:
    """Load a scene and its edits; the arguments are those of `load_stack`."""
    return load_stack([load_file(scene)], gdfs, place)


def load_stack(
    files: Sequence[SceneFile],
    gdfs: Sequence[Path],
    place: RegionChooser = _own_region,
    owners: Sequence[int] = (),
) -> Document:
    """Load the edits of one scene, or of several scenes.

    Args:
        files: the scenes; further ones stay hidden until the document is arranged, see `arrange`
        gdfs: files of the edits
        place: chooses the region of each edit's grade
        owners: scene of each edit; missing ones: the first scene

    Raises:
        ProgdfError: a file is missing or damaged, or an edit was made for another scene.
    """
    first, *added = files
    edits = load_edits(gdfs, files, place, owners)
    document = Document(first.title, first.gaussians, edits, first.path, tuple(gdfs), owners=tuple(owners))
    return document.with_scenes(*added)


def load_file(path: Path) -> SceneFile:
    """Load a scene.

    Raises:
        ProgdfError: the file is missing or damaged.
    """
    path = scene_file(path)
    return SceneFile(escape_text(scene_name(path)), load_scene(path), path)


def find_owner(path: Path, files: Sequence[SceneFile], near: int) -> int:
    """Return the scene of an edit: `near` if the edit fits it, else the first one that it fits, else `near`.

    Raises:
        ProgdfError: the file is missing or damaged.
    """
    if len(files) == 1:
        return 0
    stored = read_gdf(path).scene
    order = (near, *range(len(files)))
    return next((i for i in order if stored == fingerprint(files[i].gaussians)), near)


def load_edits(
    paths: Sequence[Path],
    opened: Sequence[SceneFile],
    place: RegionChooser = _own_region,
    owners: Sequence[int] = (),
) -> tuple[Gdf, ...]:
    """Load the edits of scenes. A second edit of the same name becomes NAME-2, so that --set is unambiguous.

    Raises:
        ProgdfError: a file is missing, damaged, or was made for another scene.
    """
    gdfs: list[Gdf] = []
    for index, path in enumerate(paths):
        owner = opened[owners[index] if index < len(owners) else 0]

        def region(stored: Gdf, index: int = index, scene: Gaussians = owner.gaussians) -> Region | None:
            return place(scene, index, _free_name(stored.name, gdfs))

        name = owner.title if owner.path is None else owner.path.name
        with all_threads():
            gdf = load_gdf(path, owner.gaussians, name, region)
        gdfs.append(replace(gdf, name=_free_name(gdf.name, gdfs)))
    return tuple(gdfs)


def _free_name(name: str, gdfs: Sequence[Gdf]) -> str:
    taken = {gdf.name for gdf in gdfs}
    return next(free for free in numbered_names(name) if free not in taken)
