"""What a notebook shows of a scene, a field or an edit: a picture and a few lines, as HTML."""

from __future__ import annotations

import base64
import html
import io
import math
from contextlib import suppress
from dataclasses import replace

import torch
from PIL import Image

from progdf.camera import Camera, intrinsics, look_at
from progdf.compose.layers import KINDS
from progdf.field.baked import BakedField
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf
from progdf.rasterize import render
from progdf.scene.subject import fit_camera, is_room, richest_turn, standpoint, subject_rows
from progdf.scene.up_axis import guess_up
from progdf.terminal import escape_text, file_size, format_count

_SIZE = 300, 200
_SAMPLED = 2000  # Gaussians that the camera is chosen by, and members whose course is drawn
_LONGEST = 60  # characters of a name
_COLORS = {"geometry": "#2f7ed8", "opacity": "#8a8f98", "color": "#e0652b"}


def to_html(shown: Gaussians | BakedField | Gdf) -> str:
    """A card for a notebook; without its picture where there is none to be had. Texts are a stranger's."""
    picture = ""
    with suppress(Exception):  # of numbers that no engine draws, on a machine that draws nothing
        picture = _still(shown) if isinstance(shown, Gaussians) else _chart(shown)
    title, *lines = (_plain(line) for line in _lines(shown))
    text = "".join(f"<div style='opacity:.7'>{line}</div>" for line in lines)
    return (
        "<div style='display:flex;align-items:center;gap:16px;line-height:1.5'>"
        f"{picture}<div><b>{title}</b>{text}</div></div>"
    )


def _plain(text: str) -> str:
    return html.escape(escape_text(text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"))


def _lines(shown: Gaussians | BakedField | Gdf) -> list[str]:
    """A heading, and what is known of it."""
    if isinstance(shown, Gaussians):
        stored = (getattr(shown, name) for name in ATTRIBUTES)
        size = sum(part.numel() * part.element_size() for part in stored)
        return [format_count(len(shown)), f"SH degree {shown.sh_degree}", f"{file_size(size)} in memory"]
    field = shown if isinstance(shown, BakedField) else shown.field
    size = round(field.members * field.bytes_per_member)
    facts = [
        f"{field.kind} field: {', '.join(field.attributes) or 'not baked'}",
        f"{len(field.recorded)} recordings, {file_size(size)}",
    ]
    if isinstance(shown, BakedField):
        return [format_count(field.members, "member"), *facts]
    added = f", {format_count(shown.members - len(shown.region), 'row')} added" if shown.added else ""
    members = f"{format_count(len(shown.region), 'member')} of {format_count(shown.scene.count)}{added}"
    return [shown.name, *([shown.instruction] if shown.instruction else []), members, *facts]


def _still(scene: Gaussians) -> str:
    """A scene from the front on nothing, as a WebP image; "" of an empty one."""
    if not len(scene):
        return ""
    with torch.no_grad():
        scene = scene.to("cpu", torch.float32)
        camera = _first_camera(scene[:: -(-len(scene) // _SAMPLED)])
        drawn = render(scene, camera, (0.0, 0.0, 0.0), engine="cpu")
    alpha = 1 - drawn.transmittance[..., None]
    pixels = torch.cat([drawn.image / alpha.clamp_min(1e-6), alpha], dim=2).clamp(0, 1) * 255
    file = io.BytesIO()
    Image.fromarray(pixels.round().to(torch.uint8).numpy()).save(file, "WEBP", quality=80)
    width, height = _SIZE
    source = f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"
    return f"<img alt='' width={width} height={height} src='{source}'>"


def _first_camera(scene: Gaussians) -> Camera:
    """As the window meets a scene: its subject from the front and a little above, a room from inside."""
    up = guess_up(scene)
    if is_room(scene, up):
        return Camera(look_at(*standpoint(scene, up), up), intrinsics(math.radians(60.0), *_SIZE), *_SIZE)
    turn = 20.0 + richest_turn(scene[subject_rows(scene, up)], up, 20.0, 15.0)
    return fit_camera(scene, up, (turn, 15.0), _SIZE, math.radians(45.0), 0.72)


def _chart(shown: BakedField | Gdf) -> str:
    """How far each kind of change is on its way at each strength, recordings as ticks; "" where none is."""
    field = shown if isinstance(shown, BakedField) else shown.field
    rows = slice(None, None, max(1, -(-field.members // _SAMPLED)))
    some = {
        name: replace(each, end_offset=each.end_offset[rows], residual_basis=each.residual_basis[:, rows])
        for name, each in field.attributes.items()
    }
    field = replace(field, attributes=some, origin=None)
    strengths = [i / 20 for i in range(21)]
    lines = []
    for kind, color in _COLORS.items():
        names = [name for name in some if KINDS[name] == kind]
        ends = {name: float(field.attribute_offsets(name, 1.0).norm()) for name in names}
        names = [name for name in names if ends[name] > 0]
        if not names:
            continue
        way = [
            sum(float(field.attribute_offsets(n, s).norm()) / ends[n] for n in names) / len(names)
            for s in strengths
        ]
        points = " ".join(
            f"{190 * s + 5:.1f},{115 - 100 * y:.1f}" for s, y in zip(strengths, way, strict=True)
        )
        lines += [f"<polyline points='{points}' fill='none' stroke='{color}' stroke-width='2'/>"]
        lines += [f"<text x='9' y='{5 + 13 * len(lines) // 2}' fill='{color}' font-size='11'>{kind}</text>"]
    ticks = "".join(f"<path d='M{190 * s + 5:.1f} 116v5' stroke='currentColor'/>" for s in field.recorded)
    frame = "<path d='M5 4v112h190' fill='none' stroke='currentColor' opacity='.35'/>"
    body = f"{frame}{ticks}{''.join(lines)}"
    return f"<svg width='200' height='126' viewBox='0 0 200 126'>{body}</svg>" if lines else ""
