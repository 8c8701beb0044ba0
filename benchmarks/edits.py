"""The benchmark `edits`: finished runs compared with simpler methods, at many slider values and in far views.

The slider is compared with two keyframes, re-timed like it, and with a cross-fade of the rendered ends. The
benchmark takes measurements too slow for the report of each run: 101 slider values, and views far from the
training views.

    python -m benchmarks edits --runs RUN …
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from progdf.camera import Camera, look_at
from progdf.errors import ProgdfError
from progdf.field.baked import interpolate_at
from progdf.field.choose import Field, sample_strengths
from trainer.editors import editor_row
from trainer.evaluate.opened import FADE, KEYFRAMES, SLIDER, OpenedRun, open_run
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.optimize.losses import perceptual_loss
from trainer.report.measures import error_curves
from trainer.views.boxes import Pictures
from trainer.views.choose import split_held_out
from trainer.views.view import View, crop, make_view

from .ablation.setup import editor_pictures
from .table import Table, mean_worst

RAISED = (30.0, -15.0)  # elevation of far views relative to a held-out one, degrees
ZOOM = 3.0  # magnification of the third far view

VALUES = 101  # slider values compared with the recording
ASKED = 20  # evenly spaced strengths at which the worst picture of the slider is searched

EDIT_NOTE = (
    "PSNR on all held-out views, over the pixels that show the region or that the editor changes; LPIPS over "
    "each view's box. 2 keyframes: each Gaussian goes straight from the original to the full edit, in raw "
    "parameters or in OKLab, whichever is closer to the editor's pictures, re-timed like the slider. "
    "Cross-fade: the rendered ends, blended in sRGB. Even: smallest over largest change of 20 equal steps. "
    "A file holds the field, the region, the plan and the report. Worst: the "
    f"lowest of {ASKED} even strengths, most of them without a training picture, with its slider value, "
    "which is interpolated linearly between those of the training strengths."
)
SLIDER_NOTE = (
    "Against the recording, on the half of the held-out views on which the field was not chosen. Far views: "
    f"each of these from {RAISED[0]:.0f}° above, from {-RAISED[1]:.0f}° below, and magnified {ZOOM:.0f} "
    "times; they are not used for training or choice. An editor that is a function of the picture edits "
    "these views too, at the training strengths."
)


def tables(runs: Sequence[Path] = ()) -> list[Table]:
    """Measure finished runs.

    Raises:
        ProgdfError: no run is named, or one is not finished.
    """
    if not runs:
        raise ProgdfError("edits are those of finished runs; name some with --runs")
    opened = [open_run(run) for run in runs]
    return [edit_table(opened), slider_table(opened)]


def edit_table(opened: Sequence[OpenedRun]) -> Table:
    """Compare each edit with the editor's pictures."""
    perceptual, _ = perceptual_loss()
    contenders = {
        "slider, about s = ¼ / ½ / ¾, dB": SLIDER,
        "2 keyframes, re-timed": KEYFRAMES,
        "cross-fade": FADE,
    }
    rows = []
    for run in opened:
        strength = dict(run.trajectory.stage_strengths)
        curves = error_curves(
            run.evaluator,
            run.contenders(),
            tuple(strength),
            lambda s, run=run, strength=strength: run.evaluator.edited[strength[s]],  # type: ignore[misc]
            perceptual,
        )
        quarters = [
            min(range(len(strength)), key=lambda i, q=q: abs(list(strength)[i] - q))  # type: ignore[misc]
            for q in (0.25, 0.5, 0.75)
        ]
        between = len(strength) > 1
        size = run.gdf.field.bytes_per_member
        rows.append(
            {
                "edit": _title(run),
                **{
                    heading: " / ".join(f"{curves[name].psnr[i]:.1f}" for i in quarters) if between else "-"
                    for heading, name in contenders.items()
                },
                **worst_places(run),
                "all at 1": f"{curves[SLIDER].psnr[-1]:.1f}",
                f"{perceptual.name} at 1": f"{curves[SLIDER].lpips[-1]:.4f}",
                "even": f"{run.report['slider']['uniformity']:.2f}",
                "bytes a Gaussian, field / file": f"{size:.0f} / {_file_bytes(run):.0f}",
                "run, s": f"{run.report['time']['total']:.0f}",
            }
        )
    return Table.of("edits", "Edits against the editor's own pictures", rows, EDIT_NOTE)


def slider_table(opened: Sequence[OpenedRun]) -> Table:
    """Compare each field with its recording, at 101 slider values and in far views."""
    rows = []
    for run in opened:
        _, reporting = run.evaluator.halves()
        field = run.gdf.field
        inner = [i / (VALUES - 1) for i in range(1, VALUES - 1)]
        samples = sample_strengths()
        ours = run.report["field"]
        far = far_evaluator(run)
        rows.append(
            {
                "edit": _title(run),
                "field, mean / worst of 13 values, dB": f"{ours['psnr_mean']:.1f} / {ours['psnr_worst']:.1f}",
                "2 keyframes": mean_worst(_against_recording(run, run.keyframes, reporting, samples)),
                f"worst of {VALUES} values": f"{min(_against_recording(run, field, reporting, inner)):.1f}",
                "far views, mean / worst of 13": mean_worst(_against_recording(run, field, far, samples)),
                **_in_far_views(run, far),
            }
        )
    title = "Fields against their recordings, and edits in far views"
    return Table.of("slider values", title, rows, SLIDER_NOTE)


def worst_places(run: OpenedRun) -> dict[str, str]:
    """Find the lowest PSNR of the slider and of each simpler method, with its slider value."""
    headings = "worst of the slider, at s", "of 2 keyframes", "of the cross-fade"
    strengths = [(i + 1) / ASKED for i in range(ASKED)]
    pictures = _editor_pictures(run, run.setup.judging, strengths)
    if not pictures:
        return dict.fromkeys(headings, "-")
    slider_values, stage_strengths = zip((0.0, 0.0), *run.trajectory.stage_strengths, strict=True)
    knots, values = (torch.tensor(some, dtype=torch.float64) for some in (stage_strengths, slider_values))
    cells = []
    for pictures_at in run.contenders().values():
        errors = []
        for strength, edited in pictures.items():
            s = float(interpolate_at(knots, values, strength))
            boxes = [
                crop(picture, scene.box) for picture, scene in zip(edited, run.evaluator.crops, strict=True)
            ]
            errors.append((run.evaluator.psnr(pictures_at(s), boxes), s))
        cells.append("{:.1f} at {:.2f}".format(*min(errors)))
    return dict(zip(headings, cells, strict=True))


def _editor_pictures(run: OpenedRun, views: Sequence[View], strengths: Sequence[float]) -> Pictures:
    """Return the editor's pictures, see `editor_pictures`; none if the editor edits views one by one."""
    if editor_row(run.run.record.plan.editor).per_view:
        return {}
    return editor_pictures(run.run, run.setup.views, views, strengths)


def far_evaluator(run: OpenedRun) -> Evaluator:
    """Prepare an evaluator on far views, with the editor's pictures of them if the editor can make any."""
    scene = run.setup.scene
    region = run.setup.region
    setup = run.setup
    _, reporting = split_held_out(setup.judging)
    center = scene.means[region.members].mean(dim=0)
    up = setup.up.direction if setup.up is not None else torch.tensor([0.0, 1.0, 0.0])
    cameras = [far for view in reporting for far in far_cameras(view.camera, center, up)]
    views = [make_view(scene, region, camera, setup.background) for camera in cameras]
    views = [view for view in views if bool((view.mask > 0.05).any())]
    edited = _editor_pictures(run, views, run.trajectory.strengths)
    channels = run.trajectory.end.shape[1]
    return make_evaluator(scene, region, views, edited, setup.background, channels)


def far_cameras(camera: Camera, center: Tensor, up: Tensor) -> list[Camera]:
    """Return the camera raised, lowered and zoomed in, all aimed at `center`. [3], [3]"""
    unit = up / up.norm()
    arm = camera.position - center
    side = torch.linalg.cross(unit, arm)
    side = side / side.norm().clamp_min(1e-9)

    def stand(place: Tensor, zoom: float = 1.0) -> Camera:
        K = camera.K.clone()
        K[:2, :2] *= zoom
        return replace(camera, viewmat=look_at(place, center, unit), K=K)

    cameras = []
    for degrees in RAISED:
        # a positive rotation about `side` lowers the camera
        angle = -math.radians(degrees)
        rotated = arm * math.cos(angle) + torch.linalg.cross(side, arm) * math.sin(angle)
        cameras.append(stand(center + rotated))
    return [*cameras, stand(camera.position, ZOOM)]


def _against_recording(
    run: OpenedRun, field: Field, views: Evaluator, values: Sequence[float]
) -> list[float]:
    return [
        views.psnr(views.pictures(field.offsets(s)), views.pictures(run.trajectory.at(s))) for s in values
    ]


def _in_far_views(run: OpenedRun, far: Evaluator) -> dict[str, str]:
    """Compare the shipped field at 1 and between, and two keyframes between, with the editor's pictures."""
    headings = "far views: to the editor's pictures at 1", "between, mean / worst", "2 keyframes, between"
    if not far.edited:
        return dict.fromkeys(headings, "-")

    def errors(field: Field) -> list[float]:
        stages = run.trajectory.stage_strengths
        return [far.psnr(far.pictures(field.offsets(s)), far.edited[strength]) for s, strength in stages]

    shipped = errors(run.gdf.field)
    baseline = errors(run.keyframes)
    figures = f"{shipped[-1]:.1f}", mean_worst(shipped[:-1]), mean_worst(baseline[:-1])
    return dict(zip(headings, figures, strict=True))


def _title(run: OpenedRun) -> str:
    plan = run.run.record.plan
    return f"{plan.name}: {plan.editor.editor}, {len(run.gdf.region)} members"


def _file_bytes(run: OpenedRun) -> float:
    path = run.run.folder.gdf(run.run.record.plan.name)
    return path.stat().st_size / max(1, len(run.gdf.region))
