"""One HTML file that shows a scene and moves its edits, opened from anywhere, that fetches nothing.

The script is viewer/web/src/*.js put one after another, the shaders are the viewer's own, and the policy in
the page's head lets nothing else run: a .gdf's names are a stranger's text.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import html
import io
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from progdf import __version__
from shaders import load_source

MODULES = ("camera", "data", "grade", "compose", "sort", "renderer", "state", "panel", "input", "main")
"""Of `src`, each after those that it imports when it is read."""
STAGES = ("web.vert", "splat.frag", "present.vert", "present.frag", "stretch.frag")
MAIL, HOST = 25e6, 100e6
"""Bytes: what mail takes, and common hosts."""

_IMPORT = re.compile(r"^import .*?;\n", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"https?://[^\s<>\"']+[^\s<>\"'.,;:)]")


def join(modules: Sequence[str] = MODULES, then: str = "") -> str:
    """Modules of `src` one after another, and what follows them, in a function of their own."""
    folder = resources.files("viewer.web") / "src"
    parts = [(folder / f"{name}.js").read_text(encoding="utf-8") for name in modules]
    joined = "\n".join(re.sub(r"^export ", "", _IMPORT.sub("", part), flags=re.MULTILINE) for part in parts)
    return f'(() => {{\n"use strict";\n{joined}{then}}})();\n'


def build_page(
    container: bytes,
    title: str,
    credit: str,
    background: tuple[float, float, float],
    still: NDArray[np.uint8],
) -> str:
    """The page of a container, see `pack`.

    Args:
        container: the scene and its edits
        title: above the sliders and of the browser's tab
        credit: below them, with addresses as links
        background: behind the scene, 0..1
        still: what shows until the scene is there, and where WebGL2 is not. [H,W,3]
    """
    behind = "#" + "".join(f"{round(255 * channel):02x}" for channel in background)
    folder = resources.files("viewer.web") / "src"
    style = f":root {{ --behind: {behind}; }}\n" + (folder / "page.css").read_text(encoding="utf-8")
    sources = {name: _body(load_source(name).text) for name in STAGES}
    code, picture = join(), io.BytesIO()
    Image.fromarray(still).save(picture, "WEBP", quality=82)
    texts = {
        "title": html.escape(title),
        "credit": _with_links(credit),
        "version": __version__,
        "style": style,
        "style_hash": _hash(style),
        "script": code,
        "script_hash": _hash(code),
        "still": "data:image/webp;base64," + base64.b64encode(picture.getvalue()).decode(),
        "shaders": in_script(sources),
        "data": base64.b64encode(gzip.compress(container, 9, mtime=0)).decode(),
    }
    template = (folder / "page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: texts[found[1]], template)


def in_script(value: Mapping[str, Any]) -> str:
    """JSON that ends no script element, whatever its texts are."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def _body(source: str) -> str:
    """A stage without its version, which the page puts in front, and without comments."""
    text = re.sub(r"//[^\n]*", "", source.removeprefix("#version 330 core"))
    return "\n" + "\n".join(line.rstrip() for line in text.splitlines() if line.strip())


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _with_links(text: str) -> str:
    parts, at = [], 0
    for found in _LINK.finditer(text):
        address = html.escape(found[0])
        parts += [html.escape(text[at : found.start()])]
        parts += [f'<a href="{address}" rel="noopener noreferrer" target="_blank">{address}</a>']
        at = found.end()
    return "".join([*parts, html.escape(text[at:])])
