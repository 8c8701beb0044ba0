"""The field of an ablation's variant, and the figures that it deserves on held-out views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from progdf.field import BakedField, fit_keyframes
from progdf.field.baked import identity_remap, interpolate_at
from progdf.field.trajectory import Trajectory
from progdf.metrics.slider import slider_statistics
from trainer.fit.fit import fit_field
from trainer.fit.network import PART as NETWORK
from trainer.fit.network import fit_network
from trainer.fit.slider_uniformity import equalize_slider
from trainer.optimize.losses import Perceptual
from trainer.optimize.retime import resolve_slider
from trainer.options import FieldOptions, TrainOptions
from trainer.report.measures import against_editor
from trainer.report.report import SHOWN
from trainer.store.progress import RunLog
from trainer.store.state import StateFolder

from .setup import AblationSetup
from .table import Outcome
from .variants import Variant


def fit_variant(
    variant: Variant,
    trajectory: Trajectory,
    shared: AblationSetup,
    plan: TrainOptions,
    perceptual: Perceptual,
    state: StateFolder,
    log: RunLog,
) -> tuple[BakedField, Mapping[float, float]]:
    """The variant's field, and where on its slider it was shown which of the editor's strengths."""
    if variant.linear:
        offsets = trajectory.nodes
        return fit_keyframes(trajectory.s, offsets, 2), {}
    evaluator, seen = shared.evaluators(trajectory.offsets)
    remap, (choosing, reporting) = identity_remap(), evaluator.halves()
    if plan.field.field == "neural":
        setup = shared.setup
        weights = shared.weights
        begun = state.load(NETWORK)
        field = fit_network(
            trajectory, setup, seen, reporting, weights, plan.field, perceptual, log, begun=begun
        ).field
    else:
        options = FieldOptions(target_psnr=shared.plan.field.target_psnr)
        fitted = fit_field(trajectory, seen, choosing, reporting, shared.weights, options)
        field = fitted.chosen.field
        if resolve_slider(plan.optimize.slider, trajectory.strengths) == "even":
            field, remap = equalize_slider(field, shared.setup)
    return field, {strength: remap.at(s) for s, strength in trajectory.stage_strengths}


def _slider_value(asked: Mapping[float, float], strength: float, at: float) -> float:
    """Where on its slider a variant shows a strength: as it was asked, or between what it was asked; on the
    run's own slider where it was shown the end alone."""
    if strength in asked or len(asked) < 2:
        return asked.get(strength, at)
    knots = torch.tensor([0.0, *asked], dtype=torch.float64)
    return float(interpolate_at(knots, torch.tensor([0.0, *asked.values()], dtype=torch.float64), strength))


def with_figures(
    outcome: Outcome,
    field: BakedField,
    shared: AblationSetup,
    asked: Mapping[float, float],
    measure: Perceptual,
) -> Outcome:
    """With the figures that the field deserves; where it was shown no picture, on the run's own slider."""
    evaluator, _ = shared.evaluators(field.offsets(1.0)[None])
    shown = [
        (s, _slider_value(asked, e, at), e)
        for s, (at, e) in zip(SHOWN[1:], shared.columns[1:], strict=True)
        if e
    ]
    course = against_editor(evaluator, {"slider": field}, [(at, e) for _, at, e in shown], measure)["slider"]
    slider = slider_statistics(lambda s: evaluator.pictures(field.offsets(s)), masks=evaluator.pixels)
    return replace(
        outcome,
        psnr=round(course.psnr[-1], 2),
        ssim=round(course.ssim[-1], 4),
        lpips=round(course.lpips[-1], 4),
        between={f"{s:g}": round(p, 2) for (s, *_), p in zip(shown[:-1], course.psnr, strict=False)},
        uniformity=round(slider.uniformity, 3),
        t50=round(slider.t50, 3),
        t90=round(slider.t90, 3),
        bytes_per_member=round(field.bytes_per_member, 1),
    )
