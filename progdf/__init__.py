"""ProGDF Studio: edit a 3D Gaussian Splatting scene once, then slide through every degree of the edit."""

from __future__ import annotations

from progdf.camera import Camera
from progdf.camera_files import load_cameras
from progdf.checkpoint import Gdf, load_gdf, save_gdf
from progdf.compose import Layer, compose
from progdf.formats import load_scene
from progdf.gaussians import Gaussians
from progdf.ply import load_ply, save_ply
from progdf.rasterize import rasterize, render

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
