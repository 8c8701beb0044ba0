"""Field of an ablation's variant, and its figures on held-out views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from progdf.field import BakedField, fit_keyframes
from progdf.field.baked import identity_remap, interpolate_at
from progdf.field.trajectory import Trajectory
from progdf.metrics.slider import slider_statistics
from trainer.fit.fit import fit_field
from trainer.fit.network import fit_network
from trainer.fit.slider_uniformity import equalize_slider
from trainer.methods import METHODS
from trainer.optimize.losses import Perceptual
from trainer.optimize.retime import resolve_slider
from trainer.options import FieldOptions, TrainOptions
from trainer.paper.network import PART as NETWORK
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
    """Fit the variant's field; return it with the slider value of each of the editor's strengths."""
    if variant.linear:
        offsets = trajectory.nodes
        return fit_keyframes(trajectory.s, offsets, 2), {}
    evaluator, seen = shared.evaluators(trajectory.offsets)
    remap = identity_remap()
    choosing, reporting = evaluator.halves()
    if plan.field.field == "neural":
        setup = shared.setup
        weights = shared.weights
        begun = state.load(NETWORK)
        settings = METHODS[plan.preset].network_settings(plan.field)
        field = fit_network(
            trajectory,
            setup,
            seen,
            reporting,
            weights,
            plan.field,
            settings,
            perceptual=perceptual,
            log=log,
            begun=begun,
        ).field
    else:
        options = FieldOptions(target_psnr=shared.plan.field.target_psnr)
        fitted = fit_field(trajectory, seen, choosing, reporting, shared.weights, options)
        field = fitted.chosen.field
        if resolve_slider(plan.optimize.slider, trajectory.strengths) == "even":
            field, remap = equalize_slider(field, shared.setup)
    return field, {strength: remap.at(s) for s, strength in trajectory.stage_strengths}


def _slider_value(asked: Mapping[float, float], strength: float, at: float) -> float:
    """Return the slider value at which a variant shows a strength.

    Strengths that it was not trained on are interpolated. If it was trained on the end only, the run's slider
    value `at` is used.
    """
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
    """Return the outcome with the field's figures; a field trained on no picture uses the run's slider."""
    evaluator, _ = shared.evaluators(field.offsets(1.0)[None])
    columns = [
        (s, _slider_value(asked, e, at), e)
        for s, (at, e) in zip(SHOWN[1:], shared.columns[1:], strict=True)
        if e
    ]
    curve = against_editor(evaluator, {"slider": field}, [(at, e) for _, at, e in columns], measure)["slider"]
    slider = slider_statistics(lambda s: evaluator.pictures(field.offsets(s)), masks=evaluator.pixels)
    return replace(
        outcome,
        psnr=round(curve.psnr[-1], 2),
        ssim=round(curve.ssim[-1], 4),
        lpips=round(curve.lpips[-1], 4),
        between={f"{s:g}": round(p, 2) for (s, *_), p in zip(columns[:-1], curve.psnr, strict=False)},
        uniformity=round(slider.uniformity, 3),
        t50=round(slider.t50, 3),
        t90=round(slider.t90, 3),
        bytes_per_member=round(field.bytes_per_member, 1),
    )
