"""Document: the open scene and its edits, with their files."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TypeVar

import torch

from progdf.camera import Camera
from progdf.compose.added import extend
from progdf.errors import ProgdfError
from progdf.formats.ply_view import stored_view
from progdf.formats.scene_file import load_scene, scene_file, scene_name
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, load_gdf
from progdf.io.atomic import numbered_names
from progdf.region import Region
from progdf.scene.neighbors import Neighborhood
from progdf.terminal import escape_text
from progdf.threads import all_threads
from viewer.camera.view_camera import Bounds, SceneUp, bounds_of, find_scene_up, first_camera, fit, fit_all
from viewer.state.facts import layer_rows
from viewer.state.view_state import LayerState
from viewer.state.workspace import SceneFacts

_Value = TypeVar("_Value")

RegionChooser = Callable[[Gaussians, int, str], Region | None]
"""Function from a scene, an edit's index and its name to the region that the edit's grade is applied to.

It returns None if the edit keeps its own region.
"""


def _own_region(_: Gaussians, index: int, name: str) -> Region | None:
    return None


@dataclass(frozen=True)
class Document:
    """Scene and its edits, indexed by `LayerState.gdf`."""

    title: str  # name of the scene; "" if none is open
    original: Gaussians  # scene as in its file
    edits: tuple[Gdf, ...] = ()  # edits of the original, as in their files
    path: Path | None = None  # file of the scene; without one, no session can be saved
    gdf_paths: tuple[Path, ...] = ()  # files of the edits, either none or one per edit

    @cached_property
    def _extension(self) -> tuple[Gaussians, tuple[Gdf, ...]]:
        return extend(self.original, self.edits)

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
        """Up axis found from the scene and its edits."""
        return find_scene_up(self.original, self.edits, path=self.path)

    @cached_property
    def bounds(self) -> Bounds:
        """Bounds of the bulk of the original."""
        return bounds_of(self.original)

    @cached_property
    def stored_camera(self) -> Camera | None:
        """Camera stored in the scene's file, which defines the first view."""
        return None if self.path is None else stored_view(self.path, self.original.origin).camera

    def facts(self) -> SceneFacts:
        """Compute the facts for the panel and the camera."""
        scene = self.scene
        added = [gdf.members - len(gdf.region) for gdf in self.edits]
        neighborhood = _once(lambda: Neighborhood(scene))
        return SceneFacts(
            title=self.title,
            count=len(scene),
            added=len(scene) - len(self.original),
            bounds=self.bounds,
            origin=scene.origin,
            rows=layer_rows(scene, self.gdfs, added),
            fit=lambda camera, aspect: fit_all(camera, self.original, aspect),
            fit_members=lambda camera, aspect, mask: fit(camera, scene[torch.tensor(mask)], aspect),
            neighborhood=neighborhood,
            scribbles=_once(lambda: neighborhood().scribbles),
            home=lambda camera, aspect: replace(
                first_camera(self.original, (), aspect, camera.fov_y, camera.up, stored=self.stored_camera),
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
    """Load a scene and its edits.

    Args:
        scene: file or folder of the scene
        gdfs: files of its edits
        place: chooses the region of each edit's grade

    Raises:
        ProgdfError: a file is missing or damaged, or an edit was made for another scene.
    """
    scene = scene_file(scene)
    gaussians = load_scene(scene)
    edits = load_edits(gdfs, gaussians, scene, place)
    return Document(escape_text(scene_name(scene)), gaussians, edits, scene, tuple(gdfs))


def load_edits(
    paths: Sequence[Path], scene: Gaussians, scene_path: Path, place: RegionChooser = _own_region
) -> tuple[Gdf, ...]:
    """Load the edits of a scene. A second edit of the same name becomes NAME-2, so that --set is unambiguous.

    Raises:
        ProgdfError: a file is missing, damaged, or was made for another scene.
    """
    gdfs: list[Gdf] = []
    for index, path in enumerate(paths):

        def region(stored: Gdf, index: int = index) -> Region | None:
            return place(scene, index, _free_name(stored.name, gdfs))

        with all_threads():
            gdf = load_gdf(path, scene, scene_path.name, region)
        gdfs.append(replace(gdf, name=_free_name(gdf.name, gdfs)))
    return tuple(gdfs)


def _free_name(name: str, gdfs: Sequence[Gdf]) -> str:
    taken = {gdf.name for gdf in gdfs}
    return next(free for free in numbered_names(name) if free not in taken)
