"""`python -m benchmarks field`: error against bytes and milliseconds for every kind of field.

Errors are those against the edit's true course, at and between the snapshots that the fields were fitted to,
in views that the choice of ranks has not seen, over the pixels that the edit changes.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from progdf.compose.composer import Composer
from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers
from progdf.demo_scenes import bear
from progdf.field import fit_separable
from progdf.gaussians import ATTRIBUTES, Gaussians, pack
from progdf.gdf.file import Gdf
from progdf.io.atomic import atomic_write
from progdf.rasterize import set_threads
from progdf.threads import threads

from .analytic_edits import bear_edits
from .courses import KnownEdit, edit_of, known_edit, milliseconds, processor_milliseconds
from .field_forms import Form, baked_forms
from .field_plot import draw_forms
from .table import Table

EDITS = ("gold", "stripes", "big ears")
BEAR, SIDE, SNAPSHOTS = 12_000, 160, 33
CLOUDS = ((3_000, 30_000), (30_000, 100_000), (100_000, 100_000))
"""Members and Gaussians of the scenes on which a slider step is timed."""


def tables(recorded: Sequence[KnownEdit] = (), plot: Path | None = None) -> list[Table]:
    """Error against bytes and time; a slider step against copying as many bytes.

    Args:
        recorded: edits that were recorded, measured after the bear's
        plot: also draw the errors into this PNG file
    """
    scene = bear(BEAR)
    edits = bear_edits(scene)
    cameras = [camera.resize(SIDE, SIDE) for camera in scene.cameras]
    known = [known_edit(name, scene.gaussians, *edits[name], cameras, SNAPSHOTS) for name in EDITS]
    courses = [*known, *recorded]
    forms = [form for course in courses for form in baked_forms(course)]
    if plot is not None:
        with atomic_write(plot) as temporary_file:
            drawn = draw_forms(forms).quantize(128, kmeans=3, dither=Image.Dither.NONE)
            drawn.save(temporary_file, format="PNG", optimize=True)
    return [field_table(forms), _compose_table()]


def field_table(forms: Sequence[Form]) -> Table:
    """The table of all fields of all edits, in their order."""
    rows = [
        (
            f"{form.edit}, {form.members} members",
            form.label,
            f"{form.numbers:,}".replace(",", " "),
            f"{form.bytes_per_member:.0f}",
            f"{form.mean:.1f} / {form.worst:.1f}",
            f"{form.at_snapshots:.1f}",
            f"{form.seconds:.1f}",
            f"{form.step[0]:.2f}",
            f"{form.step[1]:.2f}",
        )
        for form in forms
    ]
    return Table(
        name="field",
        title="Fields: error against bytes and time",
        columns=(
            "edit",
            "field",
            "numbers",
            "bytes a member, no header",
            "PSNR between snapshots, mean / worst, dB",
            "worst at snapshots",
            "s to fit",
            "ms a slider step, 1 thread",
            "2 threads",
        ),
        rows=tuple(rows),
        note=f"Bear of {BEAR} Gaussians, {SNAPSHOTS} snapshots, against the true course; recorded edits "
        "against the recording. 13 slider values, views that no choice has seen, pixels that the edit "
        "changes. Keyframes lie at even strengths. For networks see python -m benchmarks networks. "
        f"{_at_same_bytes(forms)}",
    )


def _at_same_bytes(forms: Sequence[Form]) -> str:
    """By how much the separable field's worst error is better than the best keyframes' of the same bytes."""
    told = []
    for edit in dict.fromkeys(form.edit for form in forms):
        own = [form for form in forms if form.edit == edit]
        limit = next(form.bytes_per_member for form in own if form.label == "4 keyframes, int8") + 0.5
        best = {
            kind: max(f.worst for f in own if kind in f.kind and f.bytes_per_member <= limit)
            for kind in ("separable", "keyframes")
        }
        told.append(f"{edit} {best['separable'] - best['keyframes']:+.1f} dB")
    return (
        "Worst PSNR of the separable field less that of the best keyframes, at 6 bytes a moving number "
        f"(84 where all 14 move): {', '.join(told)}."
    )


def _compose_table() -> Table:
    rows = []
    for members, count in CLOUDS:
        rng = torch.Generator().manual_seed(0)
        scene = _cloud(count, rng)
        chosen = torch.randperm(count, generator=rng)[:members].sort().values
        offsets = torch.randn(9, members, 14, generator=rng).cumsum(dim=0)
        offsets -= offsets[:1].clone()
        strengths = torch.linspace(0, 1, 9)
        edit = edit_of(scene, chosen, fit_separable(strengths, offsets, dict.fromkeys(ATTRIBUTES, 2)))
        one = edit_of(
            scene, chosen[:1], fit_separable(strengths, offsets[:, :1], dict.fromkeys(ATTRIBUTES, 2))
        )
        rows.append(_compose_row(scene, edit, one))
    return Table(
        name="compose",
        title="A slider step: new attributes of all members",
        columns=(
            "members / Gaussians",
            "MB moved",
            "copying, ms",
            "compose, processor ms",
            "Composer 1 thread, ms",
            "2 threads, ms",
            "of these for one member",
            "ratio to copying, 1 / 2 threads",
            "largest difference",
        ),
        rows=tuple(rows),
        note="Medians, taken in turns. Moved: what a step must read (bases, the original, the last centers, "
        "row numbers) and write; copying: a NumPy copy that reads and writes as much, one thread. What one "
        "member takes does not grow. The plain compose also checks that the edit belongs to the scene.",
    )


def _compose_row(scene: Gaussians, edit: Gdf, single: Gdf) -> tuple[str, ...]:
    composer, alone = Composer(scene, [edit]), Composer(scene, [single])
    # bases, the original and the last centers are read, row numbers too, 14 numbers written
    traffic = len(edit.region) * (edit.field.bytes_per_member + 56 + 12 + 12 + 56)
    source = np.ones(int(traffic) // 8, np.float32)
    target = source.copy()
    before = threads()
    times: dict[str, list[float]] = {"plain": [], "1": [], "2": [], "copy": [], "one": []}
    difference = 0.0
    try:
        for i in range(50):
            s = 0.03 + 0.9 * i / 50
            layer = Layer(edit, s)
            if i % 10 == 0:
                times["plain"].append(processor_milliseconds(partial(compose_layers, scene, [layer])))
            for count in (1, 2):
                set_threads(count)
                composer.update([])
                times[str(count)].append(milliseconds(partial(composer.update, [layer])))
            times["one"].append(milliseconds(partial(alone.update, [Layer(single, s)])))
            times["copy"].append(milliseconds(partial(np.copyto, target, source)))
            if i % 10 == 0:
                plain = pack(compose_layers(scene, [layer]))
                difference = max(difference, float((pack(composer.gaussians) - plain).abs().max()))
    finally:
        set_threads(before)
    took = {key: statistics.median(found) for key, found in times.items()}
    return (
        f"{len(edit.region)} / {len(scene)}",
        f"{traffic / 1e6:.2f}",
        f"{took['copy']:.3f}",
        f"{took['plain']:.1f}",
        f"{took['1']:.3f}",
        f"{took['2']:.3f}",
        f"{took['one']:.3f}",
        f"{took['1'] / took['copy']:.1f} / {took['2'] / took['copy']:.1f}",
        f"{difference:g}",
    )


def _cloud(count: int, rng: torch.Generator) -> Gaussians:
    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    return Gaussians(
        means=normal(count, 3), quats=normal(count, 4), log_scales=normal(count, 3) - 4,
        logit_opacities=normal(count), sh0=normal(count, 3), shN=torch.zeros(count, 0, 3),
    )  # fmt: skip
