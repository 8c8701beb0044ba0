"""The end of every run: fit the field, measure it, write NAME.gdf, report.json and report.png."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.compose.reference import Layer, compose_layers
from progdf.errors import ProgdfError
from progdf.field.baked import identity_remap
from progdf.field.trajectory import Trajectory, load_trajectory
from progdf.gaussians import ATTRIBUTES, BASE_CHANNELS, Gaussians, pack
from progdf.gdf.file import Gdf, fingerprint, load_gdf, save_gdf
from progdf.io.images import write_image
from progdf.io.json_values import convert_json, decode_json, plain
from progdf.terminal import file_size, format_count
from trainer.editors.pictures import picture_background
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.fit.fit import evaluate_field, expected_looks, fit_field, visibility
from trainer.fit.network import fit_network
from trainer.fit.slider_uniformity import equalize_slider
from trainer.optimize.losses import Perceptual
from trainer.optimize.settings import resolve_slider
from trainer.pipeline.record import RunRecord
from trainer.report.measures import clip_curve, expected_measures, figures, measure, measure_paint
from trainer.report.report import report_picture
from trainer.setup.training_setup import TrainingSetup
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, read_views, write_json
from trainer.store.state import Saved
from trainer.views.crops import only_recolors
from trainer.views.view import View

_RANK_VIEWS = 4
_REPORT_ALONE = ("plan", "time", "memory_mb", "memory_by_stage_mb", "curves", "views", "pictures")

_LPIPS_OVER = (
    "each view's box around all that shows the region or that the editor changes, at least 64 pixels"
)


@dataclass(frozen=True)
class RunResult:
    """What a run leaves.

    Args:
        folder: the run's folder
        gdf: path of the .gdf file
        report: what report.json holds
        trajectory: what was recorded, at the slider values where the field shows it
    """

    folder: RunFolder
    gdf: Path
    report: Mapping[str, Any]
    trajectory: Trajectory


def finish_run(
    folder: RunFolder,
    setup: TrainingSetup,
    trajectory: Trajectory,
    record: RunRecord,
    perceptual: Perceptual,
    log: RunLog,
    begun: Saved | None = None,
) -> RunResult:
    """Fit, measure, and write NAME.gdf, report.json and report.png.

    Args:
        folder: of the run
        setup: scene, region, views
        trajectory: what was recorded
        record: see `RunRecord`; its plan says which field is fitted, and the report repeats the rest
        perceptual: distance of pictures
        log: of the run
        begun: see `network.fit_network`
    """
    plan = record.plan
    target, budget = plan.field.target_psnr, plan.field.bytes_budget
    scene, region = setup.scene, setup.region
    with log.stage("fit"):
        evaluator = load_evaluator(folder, setup, setup.judging, trajectory)
        choosing, reporting = evaluator.halves()
        if len(setup.held_out) == 1:
            log.say("one view alone is held out: the field is chosen and reported on it")
        if not setup.held_out:
            log.say("no view is held out: all figures are of the views that were trained on")
        few = setup.train[:: max(1, len(setup.train) // _RANK_VIEWS)][:_RANK_VIEWS]
        seen = load_evaluator(folder, setup, few, trajectory)
        with log.looks("weigh the members", len(setup.train)) as looked:
            weights = visibility(scene, region.members, setup.train, looked)
        if plan.field.field == "neural":
            network = fit_network(
                trajectory, setup, seen, reporting, weights, plan.field.network, perceptual, log, begun
            )
            fitted = evaluate_field(trajectory, reporting, network.field, target)
        else:
            network = None
            with log.looks("fit the field", expected_looks(trajectory, plan.field.field)) as looked:
                fitted = fit_field(
                    trajectory,
                    replace(seen, looked=looked),
                    replace(choosing, looked=looked),
                    replace(reporting, looked=looked),
                    weights,
                    plan.field.field,
                    target,
                    budget,
                )
    with log.stage("even"):
        slider = resolve_slider(plan.slider, trajectory.strengths)
        field, remap = fitted.chosen.field, identity_remap()
        if slider == "even":
            field, remap = equalize_slider(field, setup, log)
        shown = replace(trajectory, s=remap(trajectory.s).float())
    log.say(
        f"{fitted.chosen.label}, {fitted.why}: "
        f"{field.bytes_per_member:.0f} bytes per Gaussian without the header, "
        f"worst {fitted.chosen.worst:.1f} dB, "
        f"mean {fitted.chosen.mean:.1f} dB against {len(trajectory)} recordings "
        f"in {format_count(len(reporting.names), 'view')}"
    )
    if not fitted.met:
        if budget is not None and network is None:
            log.say(f"no field takes --bytes-budget {budget:g} or less; the smallest was kept")
        else:
            log.say(f"no field reached --target-psnr {target:g}; the best was kept")
    with log.stage("report"):
        clip = clip_curve(evaluator, setup.judging, field, plan.texts)
        if clip.reason and plan.texts.asked:
            log.say(f"CLIP directional similarity is not measured: {clip.reason}")
        with log.looks("measure the edit", expected_measures(trajectory)) as looked:
            watched, apart = (replace(views, looked=looked) for views in (evaluator, reporting))
            measured = measure(watched, apart, trajectory, fitted, field, remap, perceptual, clip)
        editor, told = plan.editor.editor, plain(plan)
        gdf = Gdf(plan.name, region, field, fingerprint(scene), editor, told)
        endpoint, outside = exactness(scene, gdf, end_rows(setup, trajectory))
        title = f"{plan.name}: {editor}"
        picture = report_picture(evaluator, measured, record.losses, title, len(setup.held_out))
    paint = None
    if plan.views.pictures:
        pictures = read_views(folder, "edited", [view.camera.name for view in setup.train], 1.0)
        files = zip(plan.views.pictures, setup.train, strict=True)
        backgrounds = [  # a run may be fitted again when its pictures are gone
            picture_background(scene, path, view.camera) if path.is_file() else setup.background
            for path, view in files
        ]
        paint = measure_paint(setup, pictures, backgrounds, end_rows(setup, trajectory))
    measures = figures(measured, endpoint, outside)
    if network is not None:
        measures["field"] |= network.figures()
    report = {
        **measures,
        "views": {
            "held_out": bool(setup.held_out),
            "edit": list(evaluator.names),
            "field_chosen": list(choosing.names),
            "field": list(reporting.names),
            "lpips_over": _LPIPS_OVER,
        },
        "trajectory": {
            "recordings": len(trajectory),
            "slider": slider,
            "s": [round(float(s), 4) for s in shown.s],
            "stages": list(trajectory.strengths),
            "stages_at": [round(s, 4) for s, _ in shown.asked],
            "attribute_worth_db": record.attribute_worth_db,
        },
        "objective": record.objective,
        "losses": record.losses,
        "kind": record.kind,
        "kind_trial": record.kind_trial,
        "agreement": record.agreement,
        "followed": record.followed,
        "paint": paint.figures() if paint is not None else None,
        "up": record.up,
        "time": {**(_earlier_figures(folder, "time") if log.refits else {}), **log.rounded_seconds()},
        "memory_mb": log.memory.peak(),
        "memory_by_stage_mb": {
            **(_earlier_figures(folder, "memory_by_stage_mb") if log.refits else {}),
            **log.memory.by_stage,
        },
        "plan": told,
        "pictures": dict(record.pictures),
    }
    # the .gdf has the options beside it, is small, and the same training writes the same file
    own = {part: value for part, value in report.items() if part not in _REPORT_ALONE}
    save_gdf(folder.gdf(plan.name), replace(gdf, report=own))
    size = folder.gdf(plan.name).stat().st_size
    report["file"] = {"bytes": size, "bytes_per_gaussian": round(size / max(1, len(region)), 1)}
    write_json(folder.report, report)
    write_image(folder.picture, picture)
    edit = report["edit"]
    log.say(
        f"{setup.judged_on}: {edit['psnr_to_views']} dB, {edit['perceptual']} {edit['lpips_to_views']}"
        + "".join(
            f"; s={float(s):.3g} {e['psnr']} dB (2 keyframes {e['keyframes2']})"
            for s, e in report["between"].items()
        )
    )
    log.say(
        f"wrote {folder.gdf(plan.name)}: {file_size(size)}, "
        f"{size / max(1, len(region)):.0f} bytes per Gaussian with all that is in it"
    )
    if paint is not None:
        log.say(f"warning: {paint.warning}" if paint.warning else paint.share)
    return RunResult(folder, folder.gdf(plan.name), report, shown)


def load_evaluator(
    folder: RunFolder, setup: TrainingSetup, views: Sequence[View], trajectory: Trajectory
) -> Evaluator:
    """Some views beside their edited pictures, as the run keeps them."""
    names = [view.camera.name for view in views]
    edited = {s: read_views(folder, "edited", names, s) for s in trajectory.strengths}
    channels, still = trajectory.end.shape[1], only_recolors(trajectory.offsets)
    return make_evaluator(setup.scene, setup.region, views, edited, setup.background, channels, still)


def end_rows(setup: TrainingSetup, trajectory: Trajectory) -> Tensor:
    """Raw member rows of the finished edit: original + end, in float32. [M,C]"""
    rows = pack(setup.scene[setup.region.members], with_shN=trajectory.end.shape[1] > BASE_CHANNELS)
    return rows + trajectory.end


def exactness(scene: Gaussians, gdf: Gdf, end: Tensor) -> tuple[float, float]:
    """Largest difference of a raw number: at s = 1 from the recorded end, and outside the region."""
    outside = torch.ones(len(scene), dtype=torch.bool)
    outside[gdf.region.members] = False
    finished = compose_layers(scene, [Layer(gdf, 1.0)])
    packed = pack(finished[gdf.region.members], with_shN=end.shape[1] > BASE_CHANNELS)
    endpoint = float((packed - end).abs().max())
    change = 0.0
    for s in (0.3, 1.0):
        edited = compose_layers(scene, [Layer(gdf, s)])
        for name in ATTRIBUTES:
            before, after = getattr(scene, name)[outside], getattr(edited, name)[outside]
            if before.numel() and not torch.equal(before, after):
                change = max(change, float((after - before).abs().max()))
    return endpoint, change


def _earlier_figures(folder: RunFolder, part: str) -> dict[str, float]:
    """Figures of the stages that this command did not run again."""
    try:
        stages = decode_json(folder.report.read_bytes())[part]
        return {str(stage): figure for stage, figure in stages.items() if isinstance(figure, int | float)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def load_result(folder: RunFolder, name: str, scene: Gaussians, log: RunLog) -> RunResult:
    """The result of a run that is finished."""
    path = folder.gdf(name)
    gdf = load_gdf(path, scene)
    trajectory, _, _ = load_trajectory(folder.trajectory)
    log.say(f"{folder.root} is finished: there is nothing left to do, and {path} is complete")
    try:
        report = convert_json(decode_json(folder.report.read_bytes()), dict[str, Any])
    except ValueError as error:
        raise ProgdfError(f"{folder.report} is damaged ({error}); train again without --resume") from error
    return RunResult(folder, path, report, replace(trajectory, s=torch.tensor(gdf.field.recorded)))
