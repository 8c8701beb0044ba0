"""ProGDF Studio: edit a 3D Gaussian Splatting scene once, then slide through every degree of the edit."""

from __future__ import annotations

from progdf.compose.reference import Layer, compose
from progdf.formats.ply import load_ply, save_ply
from progdf.formats.scene_file import load_scene
from progdf.gdf.file import Gdf, load_gdf, save_gdf
from progdf.io.cameras import load_cameras

from .camera import Camera
from .gaussians import Gaussians
from .rasterize import rasterize, render

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Gaussians",
    "Gdf",
    "Layer",
    "__version__",
    "compose",
    "load_cameras",
    "load_gdf",
    "load_ply",
    "load_scene",
    "rasterize",
    "render",
    "save_gdf",
    "save_ply",
]
