"""The benchmark `field`: error and bytes of every form of field.

Fields of color edits are compared with the editor's pictures, in views and at strengths not used for training
or choice. Fields of a motion are compared with its true trajectory.

    python -m benchmarks field
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.compose.composer import Composer
from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers
from progdf.demo_scenes import bear
from progdf.field import (
    FieldEvaluator,
    NeuralField,
    NeuralSettings,
    choose_field,
    fit_keyframes,
    fit_separable,
)
from progdf.field.baked import MONOMIALS, BakedField, identity_map
from progdf.field.choose import Field
from progdf.field.grade import bake_grade, band_offsets, fit_grade, map_form, mapped_bands
from progdf.field.neural_fit import NeuralFit, train_network
from progdf.field.separable import moving_attributes
from progdf.gaussians import ATTRIBUTES, Gaussians, pack
from progdf.gdf.file import Gdf
from progdf.metrics.image import decibels
from progdf.rasterize import set_threads
from progdf.threads import threads
from trainer.evaluate.suite.analytic_edits import bear_edits
from trainer.fit.keyframes import TwoKeyframes
from trainer.optimize.color_solver import make_solver
from trainer.optimize.color_views import add_bands

from .ablation.regret import MEASURED, REPORTING, RegretEdit
from .courses import edit_of, known_edit, milliseconds, processor_milliseconds
from .table import Table, Wall
from .training import Point, edit_of_task, save_plot, tasks

STEPS = 12  # steps of conjugate gradients for a residual at each strength
RANKS = (0, 1, 2)  # ranks of the residual

TARGETS = (40.0, 50.0, 60.0)
"""Targets of separable fields, worst PSNR to the recording, dB."""

MAX_MEMBERS = 10_000
"""Largest region that is measured; the forms of a larger one would take ten minutes."""

NETWORK = NeuralSettings("tiny", steps=1000)  # the trained network
PAPERS = NeuralSettings("paper", "position")  # the paper's network, timed untrained

MOVED = "big ears"  # measured motion, one of `bear_edits`
MOVING = 12_000  # Gaussians of the bear in motion
SIDE = 160  # side of the views of the motion, pixels
SNAPSHOTS = 33  # snapshots of the motion's recording

CLOUDS = ((3_000, 30_000), (30_000, 100_000), (100_000, 100_000))
"""Members and Gaussians of the scenes on which a slider step is timed."""


@dataclass(frozen=True)
class Form:
    """Measurements of one field of one edit."""

    edit: str
    kind: str  # name of the kind in the plot
    label: str
    bytes: float  # per member, without the header
    psnrs: tuple[float, ...]  # at `MEASURED`, dB
    seconds: float  # processor time of the fit
    chosen: bool = False  # True for the field that a run ships


def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Measure error against bytes, and the time of a slider step against a memory copy and a network.

    Args:
        scenes: further scenes, edited like those of `python -m benchmarks training`; regions of more than
            `MAX_MEMBERS` members are left out
        plot: also draw the errors into this PNG file
    """
    forms = list[Form]()
    with tempfile.TemporaryDirectory() as name:
        for task in tasks(Path(name), scenes):
            edit = edit_of_task(task)
            if len(edit.region) <= MAX_MEMBERS:
                forms += color_forms(f"{task.scene.stem}, {task.editor}", edit)
    forms += moved_forms()
    if plot is not None:
        panels: dict[str, list[Point]] = {}
        for form in forms:
            point = Point(form.kind, form.bytes, form.psnrs, form.chosen)
            panels.setdefault(form.edit, []).append(point)
        save_plot(panels, "bytes a member", plot)
    return [field_table(forms), _compose_table()]


def color_forms(name: str, edit: RegretEdit) -> list[Form]:
    """Fit and measure every form of field of a color edit."""
    judge = edit.judge()
    forms = list[Form]()

    def measure(kind: str, label: str, size: float, field: Field, began: float) -> None:
        seconds = time.process_time() - began
        psnrs = (judge.psnr(judge.pictures(field.offsets(s)), judge.edited[s]) for s in MEASURED)
        forms.append(Form(name, kind, label, size, tuple(psnrs), seconds))

    model, strengths, _, automatic = edit.automatic(judge)
    knots = torch.tensor([0.0, *strengths])
    plain = make_solver(edit.drawn, edit.original)
    recording = torch.zeros(0)
    for degree, mask in [(d, mask) for mask in dict.fromkeys((None, model.mask)) for d in MONOMIALS]:
        began = time.process_time()
        solver = plain if mask is None else plain.with_mask(mask.float() / 255.0)
        maps = [solver.fit_map(degree, edit.targets(s)) for s in strengths]
        table = torch.stack([identity_map(degree), *(table for table, _ in maps)])
        alone = replace(map_form(knots, degree, table, len(edit.original)), mask=mask)
        mapped = mapped_bands(alone, edit.original)
        bands = max(1, model.bands)
        zero = torch.zeros(len(edit.original), bands, 3)
        own = [
            solver.residual(m, zero, edit.targets(s), STEPS)[0]
            for (_, m), s in zip(maps, strengths, strict=True)
        ]
        course = torch.stack([zero, *own]).flatten(2)
        for rank in RANKS:
            form = fit_grade(knots, degree, table, course, rank, edit.weights, mask)
            field = bake_grade(form, edit.original, mapped)
            label = f"grade of degree {degree} ({len(table[0])} × 3 numbers a knot)"
            label += "" if mask is None else ", a mask"
            label += f", residual of rank {rank}" if rank else " alone"
            kind = f"grade of degree {degree}" if mask is None else f"masked grade of degree {degree}"
            measure(kind, label, form.bytes_per_member, field, began)
        if degree == max(1, model.degree) and mask is model.mask:
            moved = [add_bands(m, r) for (_, m), r in zip(maps, own, strict=True)]
            width = edit.original.shape[1]
            recording = torch.stack(
                [torch.zeros_like(edit.original), *(band_offsets(m, width) for m in moved)]
            )
    began = time.process_time()
    field = fit_keyframes(knots, recording, 2)
    measure("2 keyframes, raw", "2 keyframes, raw", field.bytes_per_member, field, began)
    straight = TwoKeyframes(edit.original, recording[-1], tuple(field.attributes), in_oklab=True)
    measure("2 keyframes, OKLab", "2 keyframes, OKLab", field.bytes_per_member, straight, began)
    views = edit.evaluator(edit.choosing, {})
    for target in TARGETS:
        began = time.process_time()
        wanted = FieldEvaluator(knots, recording, views.counted_pixels, target=target)
        best = choose_field(knots, recording, views.counted_pixels, edit.weights, evaluator=wanted).best
        label = f"{best.label}, to reach {target:g} dB"
        measure("separable", label, best.field.bytes_per_member, best.field, began)
    began = time.process_time()
    ranks = dict.fromkeys(moving_attributes(recording), 2)
    field = fit_separable(knots, recording, ranks, edit.weights)
    measure("float32 ends", "separable of rank 2, float32 ends", field.bytes_per_member, field, began)
    began = time.process_time()
    network = trained_network(edit.original, knots, recording, edit.weights, NETWORK, NETWORK.steps)
    label = f"network ({NETWORK.size}), {NETWORK.steps} steps"
    measure("network", label, network.bytes_per_member, network.bind(edit.original), began)
    chosen = f"{automatic.name.partition(': ')[2]}: shipped by a run"
    chosen_kind = f"grade of degree {model.degree}"
    if model.mask is not None:
        chosen_kind = f"masked {chosen_kind}"
    return [
        *forms,
        Form(
            name,
            chosen_kind,
            chosen,
            automatic.bytes,
            tuple(automatic.psnrs),
            automatic.seconds,
            True,
        ),
    ]


def moved_forms() -> list[Form]:
    """Fit keyframes and separable fields to a motion, and measure them against its true trajectory."""
    scene = bear(MOVING)
    cameras = [camera.resize(SIDE, SIDE) for camera in scene.cameras]
    course = known_edit(MOVED, scene.gaussians, *bear_edits(scene)[MOVED], cameras, SNAPSHOTS)
    forms = list[Form]()

    def measure(kind: str, fit: Callable[[], tuple[BakedField, str]]) -> None:
        began = time.process_time()
        field, label = fit()
        seconds = time.process_time() - began
        with torch.no_grad():
            errors = [
                (course.unseen(field.offsets(s)) - course.unseen(course.truth(s))).double().square().mean()
                for s in MEASURED
            ]
        psnrs = tuple(decibels(float(error)) for error in errors)
        chosen = label.endswith("to reach 40 dB")
        forms.append(Form(f"bear, {MOVED}", kind, label, field.bytes_per_member, psnrs, seconds, chosen))

    for count in (2, 4, 9):
        measure(
            "2 keyframes, raw" if count == 2 else "4, 9 keyframes",
            lambda c=count: (fit_keyframes(course.strengths, course.offsets, c), f"{c} keyframes, raw"),  # type: ignore[misc]
        )

    def separable(target: float) -> tuple[BakedField, str]:
        wanted = FieldEvaluator(course.strengths, course.offsets, course.look, course.truth, target=target)
        best = choose_field(
            course.strengths, course.offsets, course.look, course.weights, evaluator=wanted
        ).best
        return best.field, f"{best.label}, to reach {target:g} dB"

    for target in TARGETS:
        measure("separable", partial(separable, target))
    ranks = dict.fromkeys(moving_attributes(course.offsets), 2)
    measure(
        "float32 ends",
        lambda: (
            fit_separable(course.strengths, course.offsets, ranks, course.weights),
            "separable of rank 2, float32 ends",
        ),
    )
    return forms


def trained_network(
    rows: Tensor, knots: Tensor, recording: Tensor, weights: Tensor, settings: NeuralSettings, steps: int
) -> NeuralField:
    """Train a network on recorded offsets for a number of steps."""
    settings = settings.resolve()
    settings = replace(settings, batch=min(settings.batch, len(rows)))
    fit = NeuralFit(rows, recording.shape[2], tuple(moving_attributes(recording)), settings, weights)
    fit.scale_to(recording)
    train_network(fit, knots, recording, steps)
    return fit.field()


def field_table(forms: Sequence[Form]) -> Table:
    """Make the table of all fields of all edits, in order."""
    strengths = ", ".join(f"{s:g}" for s in MEASURED)
    rows = [
        {
            "edit": form.edit,
            "field": f"**{form.label}**" if form.chosen else form.label,
            "bytes a member, no header": f"{form.bytes:.1f}",
            "worst, dB": f"{min(form.psnrs):.1f}",
            f"at {strengths}": " ".join(f"{psnr:.1f}" for psnr in form.psnrs),
            "processor, s": f"{form.seconds:.1f}",
        }
        for form in forms
    ]
    return Table.of(
        "field",
        "Fields: error over bytes",
        rows,
        "Bold: the field that a run ships. Color edits: PSNR against the editor's pictures in "
        f"{REPORTING - 1} views not used for training or choice. All fields but the bold one are fitted to "
        f"the same recording, with {STEPS} steps of the residual at each of the run's strengths. A map is "
        "stored once for all members. The motion: PSNR against its true trajectory, over the pixels that it "
        "changes. Seconds: of the fit, for the bold grade with its solving.",
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
    return Table.of(
        "compose",
        "A slider step: new attributes of all members",
        rows,
        "Medians, measured in turns. Moved: data that a step must read (bases, the original, the last "
        "centers, row indices) and write. Copying: a NumPy copy of the same size on one thread. The time for "
        "one member does not grow with the scene. The plain compose also checks that the edit belongs to the "
        "scene. The network is evaluated once, untrained.",
    )


def _compose_row(scene: Gaussians, edit: Gdf, single: Gdf) -> dict[str, str]:
    composer = Composer(scene, [edit])
    alone = Composer(scene, [single])
    rows = pack(scene[edit.region.members])
    knots = torch.tensor([0.0, 1.0])
    ends = torch.stack([edit.field.offsets(s) for s in (0.0, 1.0)])
    asked = trained_network(rows, knots, ends, torch.ones(len(rows)), PAPERS, 0).bind(rows)
    # reads bases, the original, the last centers and row indices; writes 14 values per member
    traffic = len(edit.region) * (edit.field.bytes_per_member + 56 + 12 + 12 + 56)
    source = np.ones(int(traffic) // 8, np.float32)
    target = source.copy()
    before = threads()
    times: dict[str, list[float]] = {"plain": [], "1": [], "2": [], "copy": [], "one": [], "processor": []}
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
                used = time.process_time()
                times[str(count)].append(milliseconds(partial(composer.update, [layer])))
                if count == 1:
                    times["processor"].append(1e3 * (time.process_time() - used))
            times["one"].append(milliseconds(partial(alone.update, [Layer(single, s)])))
            times["copy"].append(milliseconds(partial(np.copyto, target, source)))
            if i % 10 == 0:
                plain = pack(compose_layers(scene, [layer]))
                difference = max(difference, float((pack(composer.gaussians) - plain).abs().max()))
    finally:
        set_threads(before)
    answer = processor_milliseconds(partial(asked.offsets, 0.5))
    took = {key: statistics.median(found) for key, found in times.items()}
    ratios = (f"{took[key] / took['copy']:.1f}" for key in ("1", "2"))
    return {
        "members / Gaussians": f"{len(edit.region)} / {len(scene)}",
        "MB moved": f"{traffic / 1e6:.2f}",
        Wall("copying, ms"): f"{took['copy']:.3f}",
        "compose, processor ms": f"{took['plain']:.1f}",
        Wall("Composer 1 thread, ms"): f"{took['1']:.3f}",
        "processor time, ms": f"{took['processor']:.3f}",
        Wall("2 threads, ms"): f"{took['2']:.3f}",
        Wall("2 threads, one member"): f"{took['one']:.3f}",
        Wall("ratio to copying, 1 / 2 threads"): " / ".join(ratios),
        "largest difference": f"{difference:g}",
        "the paper's network, processor ms": f"{answer:.0f}",
    }


def _cloud(count: int, rng: torch.Generator) -> Gaussians:
    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    return Gaussians(
        means=normal(count, 3), quats=normal(count, 4), log_scales=normal(count, 3) - 4,
        logit_opacities=normal(count), sh0=normal(count, 3), shN=torch.zeros(count, 0, 3),
    )  # fmt: skip
