"""glfw library of the imgui build, so that both share the same windows."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

BUNDLE = Path(getattr(importlib.util.find_spec("imgui_bundle"), "origin", "")).parent
_LIBRARY = BUNDLE / {"darwin": "libglfw.3.dylib", "win32": "glfw3.dll"}.get(sys.platform, "libglfw.so.3")
if _LIBRARY.exists():  # same setting as the import of imgui_bundle
    os.environ.setdefault("PYGLFW_LIBRARY", str(_LIBRARY))

import glfw  # noqa: E402

__all__ = ["BUNDLE", "glfw"]
