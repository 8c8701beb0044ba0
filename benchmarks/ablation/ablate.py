"""`python -m benchmarks ablate RUN`: which part of the method is worth what, on one's own edit.

Every variant trains towards the run's own edited views and is judged by the same held-out ones, also at
strengths that it was not shown. RUN/ablation holds ablation.json, ablation.md and ablation.png, and of each
variant its .gdf, so that one can feel the difference in the window.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.table import machine
from progdf.errors import ProgdfError
from progdf.field import BakedField, fit_keyframes
from progdf.field.remap import identity_remap
from progdf.field.trajectory import Trajectory
from progdf.gdf.file import Gdf, fingerprint, save_gdf
from progdf.io.atomic import atomic_write, make_folder
from progdf.io.images import write_image
from progdf.io.json_values import decode_json, plain
from progdf.metrics.slider import slider_statistics
from trainer.fit.fit import drop_idle_attributes, fit_field
from trainer.fit.slider_uniformity import equalize_slider
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.optimize.settings import Optimization, resolve_slider
from trainer.pipeline.reopen import reopen_run
from trainer.pipeline.threads import use_threads
from trainer.pipeline.training import optimize_members, retime_trajectory
from trainer.plan import Plan, plan_optimization
from trainer.report.curves import against_editor
from trainer.report.report import SHOWN, best_view, editor_strip, strip
from trainer.setup.training_setup import whole_views
from trainer.store.images import read_picture
from trainer.store.interrupts import interrupt_on_signals
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, lock_folder, write_json
from trainer.store.state import StateFolder

from .options import AblateOptions
from .setup import AblationSetup, digest_of, make_ablation_setup, run_plan
from .table import Outcome, outcome_line, sheet_of, table_of
from .variants import Variant, choose_variants, differing_variants

_WIDTH = 176  # of a picture in the sheet, pixels


@dataclass(frozen=True)
class Ablation:
    """All variants that are done.

    Args:
        title: one line
        outcomes: in order
        perceptual: name of the distance, LPIPS or what stands in for it
    """

    title: str
    outcomes: Sequence[Outcome]
    perceptual: str


def ablate(options: AblateOptions, quiet: bool = False) -> Ablation:
    """Train and judge the variants that are not done yet, and write the table and the picture of all.

    Args:
        options: see AblateOptions
        quiet: nothing on the screen

    Raises:
        ProgdfError: the folder is no finished run, its scene or a view is gone, a variant does not exist.
        KeyboardInterrupt: interrupted; the message says what is kept.
    """
    use_threads(options.threads)
    run = reopen_run(options.run, options.scene)
    own, kind = run_plan(run), run.record.kind
    variants = differing_variants(own, kind, len(run.trajectory.strengths), run.scene.sh_degree)
    wanted = choose_variants(variants, options.only)
    root = run.folder.root / "ablation"
    make_folder(root)
    with interrupt_on_signals(), lock_folder(RunFolder(root)):
        log = RunLog(root / "log.txt", quiet)
        try:
            shared = make_ablation_setup(run, own, kind, options.quick)
            for i, variant in enumerate(wanted):
                if _load_outcome(root, variant, shared) is not None:
                    log.say(f"{variant.name}: done before")
                    continue
                log.say(f"{variant.name} ({i + 1} of {len(wanted)}): {variant.what}")
                try:
                    _run_variant(root, variant, shared, quiet)
                except KeyboardInterrupt:
                    raise KeyboardInterrupt(
                        f"{i} of {len(wanted)} variants are done and kept in {root}; "
                        "give the same command to go on"
                    ) from None
                done = _publish(root, variants, shared)
                found = next(outcome for outcome in done.outcomes if outcome.name == variant.name)
                log.say(f"{variant.name}: {found.failed or outcome_line(found)}")
            for variant in variants:
                StateFolder(root / variant.name / "state").end()
            return _publish(root, variants, shared)
        finally:
            log.close()


def _run_variant(root: Path, variant: Variant, shared: AblationSetup, quiet: bool) -> None:
    """Train and judge one variant, and keep what became of it."""
    folder = root / variant.name
    folder.mkdir(exist_ok=True)
    plan = variant.plan(shared.plan)
    optimization = plan_optimization(plan.optimization, shared.kind, plan.optimization.group_steps or 0)
    measure, _ = perceptual_loss()
    perceptual = perceptual_loss()[0]
    objective = optimization.objective(perceptual.name)
    outcome = Outcome(variant.name, variant.what, objective=objective)
    log = RunLog(folder / "log.txt", quiet)
    try:
        trajectory = _record(root, variant, shared, plan, optimization, perceptual, log)
        seconds = log.seconds["optimize"]
    except ProgdfError as error:
        if not isinstance(error.__cause__, FloatingPointError):
            raise
        _save_outcome(folder, replace(outcome, failed=str(error.__cause__)), (), variant, shared)
        return
    finally:
        log.close()
    field, asked = _fit(variant, trajectory, shared, plan)
    outcome = _evaluate(replace(outcome, seconds=seconds), field, shared, asked, measure)
    region, scene = shared.run.region, shared.run.scene
    told = plain(replace(plan, name=variant.name))
    gdf = Gdf(variant.name, region, field, fingerprint(scene), plan.editor.editor, told)
    save_gdf(folder / f"{variant.name}.gdf", gdf)
    _save_outcome(folder, outcome, strip(shared.evaluator, field, shared.columns, _WIDTH), variant, shared)


def _record(
    root: Path,
    variant: Variant,
    shared: AblationSetup,
    plan: Plan,
    optimization: Optimization,
    perceptual: Perceptual,
    log: RunLog,
) -> Trajectory:
    """The variant's trajectory. Its optimization goes on where it was stopped, or is another variant's."""
    home = root / variant.trains_as
    home.mkdir(exist_ok=True)
    state = StateFolder(home / "state")
    begun = {"digest": digest_of(shared, variant, optimization=True)}
    if state.identity() != begun:
        state.begin(begun)
    edited = shared.edited if plan.optimization.stages != 1 else {1.0: shared.edited[1.0]}
    setup = whole_views(shared.setup) if plan.optimization.whole else shared.setup
    with log.stage("optimize"):
        trajectory, _ = optimize_members(optimization, setup, edited, perceptual, state, log)
    trajectory, _ = drop_idle_attributes(trajectory, shared.evaluator.halves()[0], optimization.prunes)
    return retime_trajectory(trajectory, setup, plan.slider, optimization.raw, log)


def _fit(
    variant: Variant, trajectory: Trajectory, shared: AblationSetup, plan: Plan
) -> tuple[BakedField, Mapping[float, float]]:
    """The variant's field, and where on its slider it was shown which of the editor's strengths."""
    if variant.linear:
        offsets = torch.stack([trajectory.node(i) for i in range(len(trajectory))])
        return fit_keyframes(trajectory.s, offsets, 2), {}
    target = shared.plan.field.target_psnr
    fitted = fit_field(trajectory, shared.seen, *shared.evaluator.halves(), shared.weights, "auto", target)
    field, remap = fitted.chosen.field, identity_remap()
    if resolve_slider(plan.slider, trajectory.strengths) == "even":
        field, remap = equalize_slider(field, shared.setup)
    return field, {strength: remap.at(s) for s, strength in trajectory.asked}


def _evaluate(
    outcome: Outcome,
    field: BakedField,
    shared: AblationSetup,
    asked: Mapping[float, float],
    measure: Perceptual,
) -> Outcome:
    """With the figures that the field deserves; where it was shown no picture, on the run's own slider."""
    evaluator = shared.evaluator
    shown = [(s, asked.get(e, at), e) for s, (at, e) in zip(SHOWN[1:], shared.columns[1:], strict=True) if e]
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
        seconds=round(outcome.seconds, 2),
    )


def _save_outcome(
    folder: Path, outcome: Outcome, pictures: Sequence[Tensor], variant: Variant, shared: AblationSetup
) -> None:
    """Write what became of a variant; the figures last, as they tell that it is done."""
    if pictures:
        write_image(folder / "strip.png", torch.cat(list(pictures), dim=1))
    write_json(folder / "outcome.json", {"digest": digest_of(shared, variant), **asdict(outcome)})


def _load_outcome(root: Path, variant: Variant, shared: AblationSetup) -> Outcome | None:
    """What became of a variant in an earlier call; None where it was not done, or on other ground."""
    try:
        found = decode_json((root / variant.name / "outcome.json").read_bytes())
        if found.pop("digest") != digest_of(shared, variant):
            return None
        return Outcome(**found)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _publish(root: Path, variants: Sequence[Variant], shared: AblationSetup) -> Ablation:
    """Table and picture of all that is done."""
    kept = [_load_outcome(root, variant, shared) for variant in variants]
    outcomes = [outcome for outcome in kept if outcome is not None]
    plan, setup, evaluator = shared.plan, shared.setup, shared.evaluator
    title = f"{plan.name}: {plan.editor.editor}, part by part"
    size = setup.held_out[0].camera
    note = (
        f"{plan.optimization.steps} steps, {len(setup.train)} views to train on and {len(setup.held_out)} "
        f"to measure with, {size.width}x{size.height} pixels, {len(shared.run.region)} members."
    )
    measure = perceptual_loss()[0].name
    distance = "LPIPS" if measure.startswith("lpips") else measure
    table = table_of(outcomes, title, distance, note)
    strips = {}
    for outcome in outcomes:
        if not outcome.failed:
            strips[outcome.name] = read_picture(root / outcome.name / "strip.png").chunk(len(SHOWN), dim=1)
    editor = [(image * 255).round() / 255 for image in editor_strip(evaluator, shared.columns, _WIDTH)]
    caption = f"held-out view {evaluator.names[best_view(evaluator)]}; PSNR to the editor's own pictures"
    write_image(root / "ablation.png", sheet_of(editor, outcomes, strips, shared.columns, title, caption))
    with atomic_write(root / "ablation.md") as beside:
        beside.write_text(table.markdown() + "\n", encoding="utf-8")
    rows: list[Mapping[str, Any]] = [asdict(outcome) for outcome in outcomes]
    about = {"machine": machine(), "note": note, "perceptual": measure, "plan": plain(plan)}
    write_json(root / "ablation.json", {**about, "variants": rows})
    return Ablation(title, outcomes, distance)
