"""What is open: a scene and its edits, with the files they came from."""

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
from viewer.camera.view_camera import SceneUp, bounds_of, find_scene_up, first_camera, fit, fit_all
from viewer.state.facts import layer_rows
from viewer.state.workspace import SceneFacts

_Made = TypeVar("_Made")

Place = Callable[[Gaussians, int, str], Region | None]
"""Gives the region of a scene that an edit's grade is applied to, by its number and its name; None where the
edit has its own."""


def _where_trained(_: Gaussians, index: int, name: str) -> Region | None:
    return None


@dataclass(frozen=True)
class Document:
    """The scene and its edits, in the order of `LayerState.gdf`."""

    title: str  # the scene's name; "" where nothing is open
    original: Gaussians  # as its file has it
    edits: tuple[Gdf, ...] = ()  # of the original, as their files have them
    path: Path | None = None  # the scene's file; None where there is none, and so no session can be saved
    gdf_paths: tuple[Path, ...] = ()  # the edits' files, one for each where there are any

    @cached_property
    def _extension(self) -> tuple[Gaussians, tuple[Gdf, ...]]:
        return extend(self.original, self.edits)

    @property
    def scene(self) -> Gaussians:
        """The original with the rows that edits add, as it is drawn with every slider at 0."""
        return self._extension[0]

    @property
    def gdfs(self) -> tuple[Gdf, ...]:
        """The edits of that scene."""
        return self._extension[1]

    @cached_property
    def detected_up(self) -> SceneUp:
        """Which way is up, as the scene and its edits tell."""
        return find_scene_up(self.original, self.edits, path=self.path)

    @cached_property
    def stored_camera(self) -> Camera | None:
        """The camera stored in the scene's file, which gives the first view."""
        return None if self.path is None else stored_view(self.path, self.original.origin).camera

    def facts(self) -> SceneFacts:
        """What the panel and the camera need to know of it."""
        scene, added = self.scene, [gdf.members - len(gdf.region) for gdf in self.edits]
        neighborhood = _once(lambda: Neighborhood(scene))
        return SceneFacts(
            title=self.title,
            count=len(scene),
            added=len(scene) - len(self.original),
            bounds=bounds_of(self.original),
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
    def file(self) -> Path:
        """The scene's file. Raises ProgdfError where it has none."""
        if self.path is None:
            raise ProgdfError("the scene has no file yet; open one first")
        return self.path

    def free_name(self, name: str) -> str:
        """An edit's name, with a number where another edit has it."""
        return _free_name(name, self.edits)


def _once(make: Callable[[], _Made]) -> Callable[[], _Made]:
    """Made when it is first asked for, by whichever thread; another one that asks meanwhile waits."""
    lock, made = threading.Lock(), cache(make)

    def ask() -> _Made:
        with lock:
            return made()

    return ask


def empty() -> Document:
    """No document yet: one splat that nothing shows, and no title."""
    row = torch.zeros(1, 3)
    none = row[:, None, :][:, :0]
    logit = torch.tensor([-20.0])
    return Document("", Gaussians(row, torch.eye(4)[:1], row - 5.0, logit, row, none))


def load(scene: Path, gdfs: Sequence[Path] = (), place: Place = _where_trained) -> Document:
    """Read a scene and its edits.

    Raises:
        ProgdfError: a file is missing or broken, or an edit was made for another scene.
    """
    scene = scene_file(scene)
    gaussians = load_scene(scene)
    edits = load_edits(gdfs, gaussians, scene, place)
    return Document(escape_text(scene_name(scene)), gaussians, edits, scene, tuple(gdfs))


def load_edits(
    paths: Sequence[Path], scene: Gaussians, scene_path: Path, place: Place = _where_trained
) -> tuple[Gdf, ...]:
    """The edits of a scene; a second one of the same name becomes NAME-2, so that --set can tell them apart.

    Raises:
        ProgdfError: a file is missing, broken, or was made for another scene.
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
