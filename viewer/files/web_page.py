"""Export of the open scene and its layers as a web page: initial state, still image, size limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch

from progdf.cli.options import absent_option
from progdf.compose.layer_paint import decode, layer_of
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, fingerprint
from progdf.io.atomic import write_file
from progdf.metrics.image import psnr
from progdf.rasterize import render
from viewer.camera.view_camera import ViewCamera, bounds_of, to_camera
from viewer.state import history, snapshots, timeline
from viewer.state.layers import largest_strength, visible_layers
from viewer.state.view_state import LayerState, Timeline, ViewState
from viewer.web.container import DRAWN_SH, pack
from viewer.web.page import HOST, MAIL_LIMIT_BYTES, PageTexts, build_page

from . import session
from .document import Document
from .session import WindowSession

PAGE = ".html"  # suffix of a page
PAGE_ASPECT = 1.0  # width / height of the part of the first view that a page shows on every screen
STILL_SIDE = 800  # side of the square of the first view that a page shows on every screen, px
STILL_SIDES = (2.1, 1.45)
"""Width and height of a page's still image in its square's sides; page.css repeats the height.

It fills a screen of 16:9 beside the panel, and a phone above the panel.
"""
_EXACT_DB = 99.0  # PSNR from which the error is not reported


@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """Options of a web page (.html)."""

    quality: Literal["exact", "compact"] = "compact"
    """Precision of a .html page: float32, or 8 and 16 bits at a third of the size."""
    sh: Literal[0, 1, 2, 3] = 3
    """Largest SH degree in a .html page."""
    layers: Annotated[str | None, absent_option("NAME[,NAME2]", "all")] = None
    """Layers that get a slider in a .html page; the others are fixed."""
    title: Annotated[str | None, absent_option("TEXT", "the scene's name")] = None
    """Text above the sliders of a .html page."""
    credit: Annotated[str, absent_option("TEXT", "none")] = ""
    """Text below the sliders: author and license of the scene; addresses become links."""


def write_page(
    out: Path,
    document: Document,
    view: ViewState,
    kept: Sequence[snapshots.SliderSnapshot] = (),
    options: PageOptions = PageOptions(),
) -> str:
    """Write a web page.

    Args:
        out: output file
        document: the scene and its edits
        view: initial state
        kept: snapshots to include
        options: options of the page

    Returns:
        One line that describes the contents of the page.

    Raises:
        ProgdfError: an option names an unknown layer, or the page cannot be written.
    """
    shown = session.visible_only(WindowSession(document, view, tuple(kept)))
    document = shown.document
    view = shown.view
    kept = shown.snapshots
    stage, edits = first_state(document, view, kept, options)
    gdfs = [document.gdfs[i] for i in edits]
    title = options.title or Path(document.title).stem
    start = still_picture(document.scene, document.gdfs, view)
    texts = PageTexts(title, options.credit, view.background, start)
    degree = min(options.sh, document.scene.sh_degree)
    packed = pack(document.scene, gdfs, options.quality, degree, stage)
    html = build_page(packed.data, texts)
    write_file(out, html)
    error = psnr(still_picture(packed.scene, document.gdfs, view, bands=DRAWN_SH[degree]), start)
    size = len(html.encode())
    whole = document.scene.sh_degree
    parts = [f"{size / 1e6:.2f} MB", options.quality]
    parts += [f"SH degree {degree} of {whole}"] if degree < whole else []
    parts += [f"{error:.1f} dB to the scene"] if error < _EXACT_DB else []
    takes = "common hosts accept" if size > HOST else "most mail servers accept"
    warning = f"; larger than {takes}: use --sh 0 or fewer Gaussians" if size > MAIL_LIMIT_BYTES else ""
    return f"wrote {out}: {', '.join(parts)}{warning}"


def still_picture(
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    view: ViewState,
    side: int = STILL_SIDE,
    bands: int = DRAWN_SH[-1],
) -> torch.Tensor:
    """Render the still image of a page: a square of the view's field of view, and what is around it.

    Args:
        scene: the scene, or its quantized copy from a page
        gdfs: its edits
        view: layers and camera
        side: side of the square, px
        bands: number of drawn SH coefficients above degree 0

    Returns:
        [H,W,3], 0 to 1
    """
    width, height = (round(sides * side) for sides in STILL_SIDES)
    tangent = math.tan(math.radians(view.camera.fov_y) / 2) * height / side
    wide = replace(view.camera, fov_y=2 * math.degrees(math.atan(tangent)))
    return picture(scene, gdfs, replace(view, camera=wide), (width, height), bands)


def picture(
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    view: ViewState,
    size: tuple[int, int],
    bands: int = DRAWN_SH[-1],
) -> torch.Tensor:
    """Render a view with the CPU engine.

    Args:
        scene: the scene, or its quantized copy from a page
        gdfs: its edits
        view: layers and camera
        size: width and height, px
        bands: number of drawn SH coefficients above degree 0

    Returns:
        [H,W,3], 0 to 1
    """
    with torch.no_grad():
        scene_fingerprint = fingerprint(scene)  # `scene` may be a page's copy
        edited = compose_view(scene, [replace(gdf, scene=scene_fingerprint) for gdf in gdfs], view)
        edited = replace(edited, shN=edited.shN * (torch.arange(edited.shN.shape[1]) < bands)[:, None])
        camera = to_camera(view.camera, *size)
        return render(edited, camera, background=view.background, engine="cpu").image.clamp(0.0, 1.0)


def compose_view(scene: Gaussians, gdfs: Sequence[Gdf], view: ViewState, share: float = 1.0) -> Gaussians:
    """Compose the scene with the layers of a view, at a share of their strengths."""
    states = visible_layers(view)
    layers = [layer_of(gdfs[s.gdf], share * s.strength, s.gains, s.paint, s.blend) for s in states]
    return compose_layers(scene, layers, view.blend)


def first_state(
    document: Document,
    view: ViewState,
    kept: Sequence[snapshots.SliderSnapshot] = (),
    options: PageOptions = PageOptions(),
) -> tuple[dict[str, Any], list[int]]:
    """Build the initial state of a page, as read by viewer/web/src/main.js.

    Returns:
        The state, and the sorted indices of the edits that the page needs.
    """
    paints: list[tuple[int, Any]] = []
    known: dict[tuple[int, str], int] = {}
    sliders = _slider_layers(view, options.layers)
    stacks = [view.layers, *(each.edit.layers for each in kept)]
    needed = {l.gdf for stack in stacks for l in stack if l.strength > 0.0 or l.name in sliders}
    divided = {l.gdf for stack in stacks for l in stack if l.gains.color != l.gains.texture}
    repainted = {
        l.gdf for stack in stacks for l in stack if l.gains.color != 1.0 and document.gdfs[l.gdf].paints
    }
    edits = sorted(needed | {gdf for key in view.timeline.keys for gdf, s in key.strengths if s > 0.0})

    def layer(state: LayerState) -> dict[str, Any]:
        gdf = document.gdfs[state.gdf]
        weights = decode(state.paint, gdf.members, gdf.from_others)
        if weights is not None and (state.gdf, state.paint) not in known:
            known[state.gdf, state.paint] = len(paints)
            paints.append((edits.index(state.gdf), weights))
        return {
            "edit": edits.index(state.gdf),
            "fixed": state.name not in sliders,
            "name": state.name,
            "strength": state.strength,
            "enabled": state.enabled,
            "solo": state.solo,
            "gains": asdict(state.gains),
            "paint": known.get((state.gdf, state.paint), -1),
            "group": state.group,
            "blend": state.blend,
        }

    def stack(camera: ViewCamera, of: ViewState | history.Edit) -> dict[str, Any]:
        return {
            "camera": camera_json(camera),
            "blend": of.blend,
            "layers": [layer(state) for state in of.layers if state.gdf in edits],
            "groups": [asdict(group) for group in of.groups],
        }

    stage = {
        **stack(view.camera, view),
        "background": view.background,
        "radius": bounds_of(document.original).radius,
        "near": to_camera(view.camera, 1, 1).near,
        "most": largest_strength(view),
        "snapshots": [{"name": each.name, **stack(each.camera, each.edit)} for each in kept],
        "timeline": _film(view.timeline, edits),
        "paints": paints,
        "split": [i for i, gdf in enumerate(edits) if gdf in divided | repainted],
    }
    return stage, edits


def _film(film: Timeline, edits: Sequence[int]) -> dict[str, Any] | None:
    """Sample a timeline frame by frame: the keyed strengths, and the camera if it is keyed."""
    if not film.keys:
        return None
    frames = []
    for frame in range(film.length + 1):
        camera = timeline.camera_at(film, frame)
        strengths = timeline.strengths_at(film, frame)
        moved = [(edits.index(gdf), s) for gdf, s in strengths.items() if gdf in edits]
        frames.append({"strengths": moved, "camera": None if camera is None else camera_json(camera)})
    return {
        "frames": frames,
        "keys": sorted({key.frame for key in film.keys}),
        "fps": film.fps,
        "ping_pong": film.ping_pong,
    }


def _slider_layers(view: ViewState, names: str | None) -> set[str]:
    """Return the names of the layers that get a slider. Raises ProgdfError for an unknown layer."""
    known = {layer.name for layer in view.layers}
    if names is None:
        return known
    chosen = {name.strip() for name in names.split(",") if name.strip()}
    for name in sorted(chosen - known):
        names = f"the layers are {', '.join(sorted(known))}" if known else "there are no layers"
        raise ProgdfError(f"--layers {name}: there is no layer of that name; {names}")
    return chosen


def camera_json(camera: ViewCamera) -> dict[str, Any]:
    """Convert a camera to the page's format."""
    return {name: value for name, value in asdict(camera).items() if name != "mode"}
