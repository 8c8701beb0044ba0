"""ProGDF Studio: edit a 3D Gaussian Splatting scene once, then set the strength of the edit with a slider."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import MutableMapping
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

__version__ = "1.0.0"

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

_PUBLIC_MODULES = {
    "Camera": "progdf.camera",
    "Gaussians": "progdf.gaussians",
    "Gdf": "progdf.gdf.file",
    "Layer": "progdf.compose.layers",
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


_NOTEBOOK_CARDS = (
    ("progdf.gaussians", "Gaussians"),
    ("progdf.field.baked", "BakedField"),
    ("progdf.gdf.file", "Gdf"),
)
"""Module and class of each type that is displayed as a card in a notebook."""


_WAIT_VARIABLES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME", "KMP_LIBRARY")
"""Variables by which a user chooses how idle OpenMP threads wait (GNU, Intel and LLVM)."""


def wait_passively(environment: MutableMapping[str, str]) -> None:
    """Let torch's idle threads sleep instead of spinning, unless the user has chosen otherwise.

    Beside other busy programs, spinning threads take the cores from the threads that they wait for. OpenMP
    reads the variables once, when torch is imported; programs that this one starts inherit them.

    Args:
        environment: variables of the process, changed in place; a value of the user stays
    """
    if not any(name in environment for name in _WAIT_VARIABLES):
        environment["OMP_WAIT_POLICY"] = "PASSIVE"


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that `progdf --help` does not wait for torch."""
    if name == "Widget":
        raise AttributeError("progdf.Widget is now viewer.Widget; write `from viewer import Widget`")
    if name not in _PUBLIC_MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC_MODULES[name]), name)


def _notebook_card(shown: Any) -> str:
    """Return the HTML card of a scene, a field or an edit."""
    from progdf.summary import to_html

    return to_html(shown)


def _register_notebook_cards() -> None:
    """Register the HTML cards of scenes, fields and edits in a running IPython."""
    ipython = sys.modules.get("IPython")
    shell = getattr(ipython, "get_ipython", lambda: None)()
    if shell is None:
        return
    html = shell.display_formatter.formatters["text/html"]
    for module, name in _NOTEBOOK_CARDS:
        html.for_type_by_name(module, name, _notebook_card)


_register_notebook_cards()
if "torch" not in sys.modules:  # later it has no effect
    wait_passively(os.environ)
