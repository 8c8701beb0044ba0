"""Edited scene as a file: composed Gaussians, a bundle with its session, and a grade's color map."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch

from progdf.compose.added import remaining_rows
from progdf.errors import ProgdfError
from progdf.field.baked import GradeForm, lattice_colors, lattice_side
from progdf.field.grade import mapped_lattice
from progdf.formats.cube import SIDE, write_cube
from progdf.gaussians import Gaussians
from progdf.io.bundle import write_bundle
from progdf.metrics.image import NO_DIFFERENCE
from progdf.metrics.readback import ReadBack
from progdf.scene.strays import picture_difference
from progdf.terminal import file_size
from viewer.files import session
from viewer.files.document import Document
from viewer.files.session import WindowSession
from viewer.files.web_page import compose_view
from viewer.state.layers import describe_strengths, visible_layers
from viewer.state.view_state import ViewState


def compose(document: Document, view: ViewState, share: float = 1.0, whole: bool = False) -> Gaussians:
    """Return the visible scenes at a share of the strengths.

    Rows that draw nothing are left out, unless `whole`.
    """
    edited = compose_view(document.scene, document.gdfs, view, share)
    rows = torch.arange(len(edited)) if whole else remaining_rows(document.original, edited)
    hidden = torch.zeros(len(edited), dtype=torch.bool)
    hidden[: len(document.original)] = document.hidden
    if bool(hidden.any()):
        rows = rows[~hidden[rows]]
    return edited if len(rows) == len(edited) else edited[rows]


def describe_loss(out: Path, edited: Gaussians, read_back: ReadBack | None) -> str:
    """Return the size of a written scene, and its largest shift and picture error when it is read back.

    Args:
        out: the file
        edited: the scene that was written
        read_back: the scene in the file; None for a .usdc, which is not read
    """
    size = f"{file_size(out.stat().st_size)}, {out.stat().st_size / len(edited):.1f} bytes each"
    if read_back is None:
        return f"{size}, exact float32"
    shift = "positions exact"
    if read_back.position_error:
        shift = f"positions within {read_back.position_error:.2g}"
    mean, worst = picture_difference(edited, read_back.scene)
    pictures = f"{mean:.1f} dB to it, {worst:.1f} at worst"
    if mean == NO_DIFFERENCE:
        pictures = "no pixel differs"
    return "; ".join([size, f"read back: {shift}, {pictures}", *read_back.notes])


def save_bundle(out: Path, opened: WindowSession) -> str:
    """Write the scene, its edits and the session in one file; return a line about it.

    Raises:
        ProgdfError: see `session.save`.
    """
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        source = Path(folder) / "stack.session.json"
        session.save(source, opened)
        count = write_bundle(out, source)
    return f"wrote {out}: {file_size(out.stat().st_size)}, {count} files; open it with progdf view"


def save_cube(out: Path, document: Document, view: ViewState) -> str:
    """Write the color map of one grade as a .cube file, at its strength and its color gain; return a line.

    Raises:
        ProgdfError: another number of layers is visible, or the edit is no grade.
    """
    states = visible_layers(view)
    forms = [document.gdfs[state.gdf].field.origin for state in states]
    form = forms[0] if forms else None
    if len(forms) != 1 or not isinstance(form, GradeForm):
        raise ProgdfError(f"{out} holds the color map of one grade; give one edit that is a grade")
    (state,) = states
    side = SIDE if form.degree else lattice_side(form.table.shape[1])
    same = lattice_colors(side)
    table = same + state.gains.color * (mapped_lattice(form, state.strength, side) - same)
    write_cube(out, table, state.name)
    parts = {
        "mask": form.mask is not None,
        "residual": len(form.residual),
        "clarity": "clarity=" in document.gdfs[state.gdf].instruction,
        "paint": state.paint,
    }
    left_out = "".join(f"; its {name} is left out" for name, part in parts.items() if part)
    return f"wrote {out}: {side}³ colors, {describe_strengths(view)}{left_out}"
