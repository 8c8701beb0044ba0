"""ProGDF Studio: edit a 3D Gaussian Splatting scene once, then slide through every degree of the edit."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from progdf.compose.layers import Layer
    from progdf.formats.ply import load_ply, save_ply
    from progdf.formats.scene_file import load_scene, save_scene
    from progdf.gdf.file import Gdf, load_gdf, save_gdf
    from progdf.io.cameras import load_cameras

    from .camera import Camera
    from .compose.reference import compose_layers
    from .gaussians import Gaussians
    from .rasterize import render

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Gaussians",
    "Gdf",
    "Layer",
    "__version__",
    "compose_layers",
    "load_cameras",
    "load_gdf",
    "load_ply",
    "load_scene",
    "render",
    "save_gdf",
    "save_ply",
    "save_scene",
]

_MODULES = {
    "Camera": "progdf.camera",
    "Gaussians": "progdf.gaussians",
    "Gdf": "progdf.gdf.file",
    "Layer": "progdf.compose.layers",
    "Widget": "viewer.widget",  # by name alone, as the table of commands names its packages; not of `__all__`
    "compose_layers": "progdf.compose.reference",
    "load_cameras": "progdf.io.cameras",
    "load_gdf": "progdf.gdf.file",
    "load_ply": "progdf.formats.ply",
    "load_scene": "progdf.formats.scene_file",
    "render": "progdf.rasterize",
    "save_gdf": "progdf.gdf.file",
    "save_ply": "progdf.formats.ply",
    "save_scene": "progdf.formats.scene_file",
}


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first asked for: `progdf --help` does not wait for torch."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
