"""Web page: a scene and its edits in one HTML file with working sliders, which loads nothing else.

The script is the concatenation of src/*.js, and the shaders are the viewer's own. The content security policy
in the page's head blocks everything else, as the names in a .gdf are third-party text.
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
from dataclasses import dataclass
from importlib import resources
from typing import Any

from torch import Tensor

from progdf import __version__
from progdf.color.edits import hex_color
from progdf.io.images import to_picture
from progdf.system.equality import equal_fields
from shaders import load_source

MODULES = (
    "camera",
    "data",
    "grade",
    "follow",
    "moves",
    "paint",
    "compose",
    "sort",
    "renderer",
    "state",
    "panel",
    "input",
    "main",
)
"""Modules of `src`, each after its imports. The module of the page's host, `start` or `widget`, follows."""
STAGES = ("web.vert", "splat.frag", "present.vert", "present.frag", "stretch.frag")
MAIL_LIMIT_BYTES = 25e6
"""Size limit of attachments in mail, bytes."""
HOST = 100e6
"""Size limit of common web hosts, bytes."""

_IMPORT = re.compile(r"^import .*?;\n", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"https?://[^\s<>\"']+[^\s<>\"'.,;:)]")


def join(modules: Sequence[str] = (*MODULES, "start"), then: str = "") -> str:
    """Concatenate modules of `src`, followed by `then`, inside a function."""
    parts = [_source(f"{name}.js") for name in modules]
    joined = "\n".join(re.sub(r"^export ", "", _IMPORT.sub("", part), flags=re.MULTILINE) for part in parts)
    return f'(() => {{\n"use strict";\n{joined}{then}}})();\n'


def build_widget() -> str:
    """Return the anywidget module that shows the page in a notebook cell, see viewer/web/src/widget.js."""
    script = join((*MODULES, "widget"), f"return (view) => render(view, {in_script(_shaders())});\n")
    return f"const render = {script}export default {{ render }};\n"


@dataclass(frozen=True)
class PageTexts:
    """Texts and colors of a page besides its scene."""

    __eq__ = equal_fields

    title: str  # above the sliders, and in the browser's tab
    credit: str  # below the sliders, with addresses as links
    background: tuple[float, float, float]  # behind the scene, 0..1
    still: Tensor  # shown until the scene is loaded, and without WebGL2, 0..1. [H,W,3]

    @property
    def style(self) -> str:
        """Style sheet."""
        return f":root, :host {{ --behind: {hex_color(self.background)}; }}\n{_source('page.css')}"

    @property
    def shade(self) -> str:
        """Class of the panel's colors, "dark" before a background darker than middle gray."""
        red, green, blue = self.background
        return "dark" if 0.2126 * red + 0.7152 * green + 0.0722 * blue < 0.5 else "light"

    @property
    def body(self) -> str:
        """Elements that the script fills."""
        picture = io.BytesIO()
        to_picture(self.still).save(picture, "WEBP", quality=82)
        still = "data:image/webp;base64," + base64.b64encode(picture.getvalue()).decode()
        texts = {"title": html.escape(self.title), "credit": _with_links(self.credit), "still": still}
        return _fill("body.html", texts)

    @property
    def markup(self) -> str:
        """Page inside its own element, with its style, for a shadow root."""
        return f'<style>{self.style}</style>\n<div class="page">\n{self.body}</div>'


def build_page(container: bytes, texts: PageTexts) -> str:
    """Return the page of a container, see `pack`, as a file."""
    style = texts.style
    code = join()
    parts = {
        "title": html.escape(texts.title),
        "version": __version__,
        "shade": texts.shade,
        "style": style,
        "style_hash": _hash(style),
        "body": texts.body,
        "script": code,
        "script_hash": _hash(code),
        "shaders": in_script(_shaders()),
        "data": base64.b64encode(gzip.compress(container, 9, mtime=0)).decode(),
    }
    return _fill("page.html", parts)


def _source(name: str) -> str:
    return (resources.files("viewer.web") / "src" / name).read_text(encoding="utf-8")


def _shaders() -> dict[str, str]:
    return {name: _body(load_source(name).text) for name in STAGES}


def _fill(template: str, texts: Mapping[str, str]) -> str:
    return re.sub(r"\{\{(\w+)\}\}", lambda found: texts[found[1]], _source(template))


def in_script(value: Mapping[str, Any]) -> str:
    """Return JSON that cannot end a script element, whatever its texts are."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def _body(source: str) -> str:
    """Return a shader stage without its version, which the page adds, and without comments."""
    text = re.sub(r"//[^\n]*", "", source.removeprefix("#version 330 core"))
    return "\n" + "\n".join(line.rstrip() for line in text.splitlines() if line.strip())


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _with_links(text: str) -> str:
    parts = []
    at = 0
    for found in _LINK.finditer(text):
        address = html.escape(found[0])
        parts += [html.escape(text[at : found.start()])]
        parts += [f'<a href="{address}" rel="noopener noreferrer" target="_blank">{address}</a>']
        at = found.end()
    return "".join([*parts, html.escape(text[at:])])
