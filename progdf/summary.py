"""HTML card of a scene, field or edit for notebooks: a picture and a few lines of text."""

from __future__ import annotations

import base64
import html
import io
from contextlib import suppress
from dataclasses import replace

import torch
from PIL import Image

from progdf.compose.layers import KINDS
from progdf.field.baked import BakedField
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf
from progdf.rasterize import render
from progdf.scene.subject import first_view
from progdf.scene.up_axis import guess_up
from progdf.terminal import escape_text, file_size, format_count

_SIZE = 300, 200  # width and height of the picture, pixels
_MAX_SAMPLED_ROWS = 2000  # Gaussians used to choose the camera, and members used for the chart
_MAX_LINE_LENGTH = 60  # characters of a line; longer lines are cut
_COLORS = {"geometry": "#2f7ed8", "opacity": "#8a8f98", "color": "#e0652b"}


def to_html(shown: Gaussians | BakedField | Gdf) -> str:
    """Return a card for a notebook, without a picture if drawing fails. Untrusted texts are escaped."""
    picture = ""
    with suppress(Exception):  # invalid numbers, or a machine that cannot draw
        picture = _still(shown) if isinstance(shown, Gaussians) else _chart(shown)
    title, *lines = (_plain(line) for line in _lines(shown))
    text = "".join(f"<div style='opacity:.7'>{line}</div>" for line in lines)
    return (
        "<div style='display:flex;align-items:center;gap:16px;line-height:1.5'>"
        f"{picture}<div><b>{title}</b>{text}</div></div>"
    )


def _plain(text: str) -> str:
    return html.escape(
        escape_text(text if len(text) <= _MAX_LINE_LENGTH else text[: _MAX_LINE_LENGTH - 1] + "…")
    )


def _lines(shown: Gaussians | BakedField | Gdf) -> list[str]:
    """Return a heading and lines of facts."""
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
    instructions = [shown.instruction] if shown.instruction else []
    return [shown.name, *instructions, members, *facts]


def _still(scene: Gaussians) -> str:
    """Return a view of a scene from the front as a transparent WebP image; "" for an empty scene."""
    if not len(scene):
        return ""
    with torch.no_grad():
        scene = scene.to("cpu", torch.float32)
        sample = scene[:: -(-len(scene) // _MAX_SAMPLED_ROWS)]
        camera = first_view(sample, guess_up(sample), _SIZE)
        drawn = render(scene, camera, (0.0, 0.0, 0.0), engine="cpu")
    alpha = 1 - drawn.transmittance[..., None]
    pixels = torch.cat([drawn.image / alpha.clamp_min(1e-6), alpha], dim=2).clamp(0, 1) * 255
    file = io.BytesIO()
    Image.fromarray(pixels.round().to(torch.uint8).numpy()).save(file, "WEBP", quality=80)
    width, height = _SIZE
    source = f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"
    return f"<img alt='' width={width} height={height} src='{source}'>"


def _chart(shown: BakedField | Gdf) -> str:
    """Return a chart of the progress of each kind of change over the strength; "" if nothing changes.

    Ticks mark the recorded strengths.
    """
    field = shown if isinstance(shown, BakedField) else shown.field
    rows = slice(None, None, max(1, -(-field.members // _MAX_SAMPLED_ROWS)))
    sampled = {
        name: replace(each, end_offset=each.end_offset[rows], residual_basis=each.residual_basis[:, rows])
        for name, each in field.attributes.items()
    }
    field = replace(field, attributes=sampled, origin=None)
    strengths = [i / 20 for i in range(21)]
    lines = []
    for kind, color in _COLORS.items():
        names = [name for name in sampled if KINDS[name] == kind]
        ends = {name: float(field.attribute_offsets(name, 1.0).norm()) for name in names}
        names = [name for name in names if ends[name] > 0]
        if not names:
            continue
        progress = [
            sum(float(field.attribute_offsets(n, s).norm()) / ends[n] for n in names) / len(names)
            for s in strengths
        ]
        points = " ".join(
            f"{190 * s + 5:.1f},{115 - 100 * y:.1f}" for s, y in zip(strengths, progress, strict=True)
        )
        lines += [f"<polyline points='{points}' fill='none' stroke='{color}' stroke-width='2'/>"]
        lines += [f"<text x='9' y='{5 + 13 * len(lines) // 2}' fill='{color}' font-size='11'>{kind}</text>"]
    ticks = "".join(f"<path d='M{190 * s + 5:.1f} 116v5' stroke='currentColor'/>" for s in field.recorded)
    frame = "<path d='M5 4v112h190' fill='none' stroke='currentColor' opacity='.35'/>"
    body = f"{frame}{ticks}{''.join(lines)}"
    return f"<svg width='200' height='126' viewBox='0 0 200 126'>{body}</svg>" if lines else ""
