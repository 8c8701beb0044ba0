"""The open scene and its layers as a web page: what the page starts with, and how large it may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.cli.options import absent_option
from progdf.compose.reference import compose_layers
from progdf.io.atomic import atomic_write
from progdf.rasterize import render
from viewer.camera.view_camera import ViewCamera, bounds_of, to_camera
from viewer.state import snapshots as kept
from viewer.state.layers import largest_strength, visible_layers
from viewer.state.paint import decode, layer_of
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import LayerState, ViewState
from viewer.web.pack import pack
from viewer.web.page import build_page

from .document import Document

SUFFIX = ".html"
_STILL = 1200, 800


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """What a web page holds (.html)."""

    quality: Literal["exact", "compact"] = "compact"
    """Of a .html page: float32, or 8 and 16 bits, a third as large."""
    sh: Literal[0, 1, 2, 3] = 3
    """Degree of the spherical harmonics that stay in a page."""
    max_size: Annotated[str | None, absent_option("SIZE", "as large as it is")] = None
    """Largest page, as in 25MB: drops what shows least, and says what."""
    layers: Annotated[str | None, absent_option("NAME[,NAME2]", "all")] = None
    """Layers that get a slider; the others stay as they are."""
    title: Annotated[str | None, absent_option("TEXT", "the scene's name")] = None
    """Above the sliders."""
    credit: Annotated[str, absent_option("TEXT", "none")] = ""
    """Below them: whose scene it is, and its license; addresses become links."""


def write_page(
    out: Path,
    document: Document,
    view: ViewState,
    snapshots: Sequence[SliderSnapshot] = (),
    options: PageOptions = PageOptions(),
) -> str:
    """Write the page; the line that says what it holds.

    Raises:
        ProgdfError: a layer is named that is not there, or the page cannot be written.
    """
    stage = _stage(document, view, snapshots, options)
    container = pack(document.scene, document.gdfs, options.quality, options.sh, stage)
    still = _picture(document, view, to_camera(view.camera, *_STILL))
    pixels = (still.clip(0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    title = options.title or Path(document.title).stem
    page = build_page(container, title, options.credit, view.background, pixels)
    with atomic_write(out) as temporary_file:
        temporary_file.write_text(page, encoding="utf-8")
    return f"wrote {out}: {len(page) / 1e6:.2f} MB"


def _picture(document: Document, view: ViewState, camera: Camera) -> NDArray[np.float32]:
    """What the CPU engine makes of the start. [H,W,3]"""
    layers = [layer_of(document.gdfs[s.gdf], s.strength, s.gains, s.paint) for s in visible_layers(view)]
    with torch.no_grad():
        edited = compose_layers(document.scene, layers, view.blend)
        return render(edited, camera, background=view.background, engine="cpu").image.numpy()


def _stage(
    document: Document, view: ViewState, snapshots: Sequence[SliderSnapshot], options: PageOptions
) -> dict[str, Any]:
    """What the page begins with, as viewer/web/src/main.js reads it."""
    paints: list[tuple[int, Any]] = []
    known: dict[tuple[int, str], int] = {}

    def layer(state: LayerState) -> dict[str, Any]:
        weights = decode(state.paint, document.gdfs[state.gdf].members)
        if weights is not None and (state.gdf, state.paint) not in known:
            known[state.gdf, state.paint] = len(paints)
            paints.append((state.gdf, weights))
        return {
            "edit": state.gdf,
            "name": state.name,
            "strength": state.strength,
            "enabled": state.enabled,
            "solo": state.solo,
            "gains": asdict(state.gains),
            "paint": known.get((state.gdf, state.paint), -1),
            "group": state.group,
        }

    listed = kept.with_original(snapshots, view)
    film = view.timeline
    return {
        "background": view.background,
        "camera": _camera(view.camera),
        "radius": bounds_of(document.original).radius,
        "near": to_camera(view.camera, 1, 1).near,
        "blend": view.blend,
        "most": largest_strength(view),
        "layers": [layer(state) for state in view.layers],
        "groups": [asdict(group) for group in view.groups],
        "snapshots": [
            {
                "name": each.name,
                "camera": _camera(each.camera),
                "layers": [layer(state) for state in each.edit.layers],
                "groups": [asdict(group) for group in each.edit.groups],
                "blend": each.edit.blend,
            }
            for each in snapshots
        ],
        "pair": kept.pair_of(listed, view.pair),
        "timeline": {
            "keys": [
                {
                    "frame": key.frame,
                    "easing": key.easing,
                    "strengths": key.strengths,
                    "camera": None if key.camera is None else _camera(key.camera),
                }
                for key in film.keys
            ],
            "length": film.length,
            "fps": film.fps,
            "ping_pong": film.ping_pong,
        }
        if film.keys
        else None,
        "paints": paints,
    }


def _camera(camera: ViewCamera) -> dict[str, Any]:
    return {name: value for name, value in asdict(camera).items() if name != "mode"}
