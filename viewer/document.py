"""What is open: a scene and its edits, with the files they came from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from progdf.checkpoint import Gdf
from progdf.formats import load_scene, scene_file, scene_name
from progdf.gaussians import Gaussians

from . import arguments
from .layer_rows import layer_rows
from .recordings import Recording, found
from .turntable import bounds_of, first_camera, fit_all
from .workspace import SceneFacts


@dataclass(frozen=True)
class Document:
    """The scene and its edits, in the order of `LayerState.gdf`.

    Args:
        title: the scene's name
        scene: the original
        gdfs: its edits
        path: the scene's file; None where there is none, and so no session can be saved
        gdf_paths: the edits' files, one for each where there are any
    """

    title: str
    scene: Gaussians
    gdfs: tuple[Gdf, ...] = ()
    path: Path | None = None
    gdf_paths: tuple[Path, ...] = ()

    def facts(self) -> SceneFacts:
        """What the panel and the camera need to know of it."""
        scene, rows = self.scene, layer_rows(self.scene, self.gdfs)
        return SceneFacts(
            title=self.title,
            count=len(scene),
            bounds=bounds_of(scene),
            rows=rows,
            recordings=self.recordings(),
            fit=lambda camera, aspect: fit_all(camera, scene, aspect),
            home=lambda camera, aspect: replace(
                first_camera(scene, (), aspect, camera.fov_y, camera.up), mode=camera.mode
            ),
        )

    def recordings(self) -> tuple[Recording, ...]:
        """Where each edit was recorded."""
        if len(self.gdf_paths) != len(self.gdfs):
            return (Recording(),) * len(self.gdfs)
        return tuple(found(gdf, path) for gdf, path in zip(self.gdfs, self.gdf_paths, strict=True))

    def free_name(self, name: str) -> str:
        """An edit's name, with a number where another edit has it."""
        taken, free, number = {gdf.name for gdf in self.gdfs}, name, 2
        while free in taken:
            free, number = f"{name}-{number}", number + 1
        return free


def load(scene: Path, gdfs: Sequence[Path] = ()) -> Document:
    """Read a scene and its edits.

    Raises:
        ProgdfError: a file is missing or broken, or an edit was made for another scene.
    """
    scene = scene_file(scene)
    gaussians = load_scene(scene)
    return Document(
        scene_name(scene), gaussians, arguments.load_edits(gdfs, gaussians, scene), scene, tuple(gdfs)
    )
