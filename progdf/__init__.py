"""ProGDF Studio: edit a 3D Gaussian Splatting scene once, then slide through every degree of the edit."""

from __future__ import annotations

from progdf.camera import Camera
from progdf.camera_files import load_cameras
from progdf.gaussians import Gaussians
from progdf.ply import load_ply, save_ply
from progdf.rasterize import rasterize, render

__version__ = "0.1.0"

__all__ = ["Camera", "Gaussians", "__version__", "load_cameras", "load_ply", "rasterize", "render", "save_ply"]
