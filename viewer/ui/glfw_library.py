"""glfw library of the imgui build, so that both share the same windows."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from progdf.system.desktop import glfw_library_name

BUNDLE = Path(getattr(importlib.util.find_spec("imgui_bundle"), "origin", "")).parent
_LIBRARY = BUNDLE / glfw_library_name()
if _LIBRARY.exists():  # same setting as the import of imgui_bundle
    os.environ.setdefault("PYGLFW_LIBRARY", str(_LIBRARY))

import glfw  # noqa: E402

__all__ = ["BUNDLE", "glfw"]
