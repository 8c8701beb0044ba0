"""End of a run: fit the field, measure it, write NAME.gdf, report.json and report.png."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.compose.added import extend
from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError
from progdf.field.baked import BakedField, identity_remap
from progdf.field.trajectory import Trajectory, load_trajectory
from progdf.gaussians import ATTRIBUTES, BASE_CHANNELS, Gaussians, pack
from progdf.gdf.file import Gdf, anchor_added, fingerprint, load_gdf, save_gdf
from progdf.io.images import write_image
from progdf.io.json_values import convert_json, decode_json, to_json
from progdf.terminal import file_size, format_count
from progdf.threads import map_threads
from trainer.editors.pictures import picture_background
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.fit.fit import Fitted, evaluate_field, expected_renders, fit_field, fit_grades, visibility
from trainer.fit.network import NetworkFit, fit_network
from trainer.fit.slider_uniformity import equalize_slider
from trainer.methods import METHODS
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.optimize.retime import resolve_slider
from trainer.options import FitOptions, TextOptions, TrainOptions, with_values
from trainer.regions.from_pictures import CHANGED
from trainer.report.measures import (
    PaintReproduction,
    against_editor,
    carry_figures,
    clip_curve,
    expected_measures,
    figures,
    measure,
    measure_above,
    measure_paint,
)
from trainer.report.report import report_picture
from trainer.resolve import BLANK, check_field_options, use_threads
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, read_views, write_json, write_views
from trainer.store.state import Saved
from trainer.views.crops import only_recolors
from trainer.views.setup import TrainingSetup
from trainer.views.view import View, render_view

from .paint import sharpen
from .record import RunRecord, render_edited_views, reopen_run

_RANK_VIEWS = 4  # number of training views on which the rank of a field is chosen
_VISIBILITY_STRIDE = 2  # every second training view measures the visibility of the members
_KEYS_OF_REPORT_ONLY = (
    *("plan", "time", "memory_mb", "curves", "views", "pictures"),
    *("losses", "trajectory", "effort", "choice", "baselines", "between"),
)
DEFAULTS = to_json(BLANK)

_LPIPS_AREA = "each view's box around the region and all edited pixels, at least 64 pixels per side"


@dataclass(frozen=True)
class RunResult:
    """Output of a run."""

    folder: RunFolder
    gdf: Path
    report: Mapping[str, Any]  # content of report.json
    # the recordings, at the slider values at which the field reproduces them; None for edits without training
    trajectory: Trajectory | None = None

    @property
    def line(self) -> str:
        """Log line with the written file and its size."""
        return f"wrote {self.gdf}: {file_size(self.report['file']['bytes'])}"


def finish_run(
    folder: RunFolder,
    setup: TrainingSetup,
    trajectory: Trajectory,
    record: RunRecord,
    perceptual: Perceptual,
    log: RunLog,
    begun: Saved | None = None,
) -> RunResult:
    """Fit and measure the field, and write NAME.gdf, report.json and report.png.

    Args:
        folder: folder of the run
        setup: scene, region, views
        trajectory: the recordings
        record: see `RunRecord`; its plan selects the field, and the report repeats the remainder
        perceptual: image distance
        log: log of the run
        begun: see `network.fit_network`
    """
    options = record.plan
    scene = setup.scene
    with log.stage("fit"):
        grown = setup.extend(trajectory.added)
        evaluator = load_evaluator(folder, grown, setup.judging, trajectory)
        _, reporting = evaluator.halves()
        fitted, network = _fit_field(
            options, grown, evaluator, trajectory, perceptual, log, folder, begun=begun
        )
    with log.stage("even"):
        slider = resolve_slider(options.optimize.slider, trajectory.strengths)
        field = fitted.chosen.field
        remap = identity_remap()
        if slider == "even":
            field, remap = equalize_slider(field, grown, log)
        if field.attributes:  # report the endpoint of the written field instead of the recorded one
            trajectory = replace(trajectory, end=field.offsets(1.0))
        shipped = replace(trajectory, s=remap(trajectory.s).float())
    log.say(_choice_line(fitted, field.bytes_per_member, len(trajectory), len(reporting.names)))
    with log.stage("report"):
        clip = clip_curve(evaluator, setup.judging, field, options.texts)
        if clip.reason and options.texts.asked:
            log.say(f"CLIP directional similarity is not measured: {clip.reason}")
        gdf = _build_gdf(options, setup, field, grown.scene[len(scene) :])
        pairs = zip(options.views.pictures, setup.train, strict=False)
        pictures = {path: view.camera for path, view in pairs}
        sharpened = sharpen(scene, gdf, pictures, options.region.region != CHANGED, log, setup.seen)
        # the viewer displays the draft during the measurements
        save_gdf(folder.draft, _on_original(gdf if sharpened is None else sharpened, setup))
        with log.looks("measure the edit", expected_measures(trajectory)) as count_view:
            judges = replace(evaluator, looked=count_view), replace(reporting, looked=count_view)
            measured = measure(judges, trajectory, fitted, field, remap, perceptual, clip)
        endpoint, outside = exactness(scene, gdf, end_rows(grown, trajectory))
        title = f"{options.name}: {options.editor.editor}"
        displayed = evaluator
        if sharpened is not None:
            gdf = sharpened
            displayed = load_evaluator(folder, setup, setup.judging, trajectory, gdf)
            slider_measures = against_editor(
                displayed, {"slider": gdf.field}, measured.asked, perceptual, most=1
            )
            measured = replace(measured, shown=gdf.field, editor={**measured.editor, **slider_measures})
        picture = report_picture(evaluator, displayed, measured, record.losses, title, len(setup.held_out))
    edited = edited_scene(scene, gdf)
    if sharpened is not None:
        write_finals(setup, edited, folder, log)
    paint = _measure_paint(folder, setup, options.views.pictures, edited)
    gdf = _on_original(gdf, setup)
    measures = figures(measured, endpoint, outside)
    if network is not None:
        measures["field"] |= network.figures()
    report = {
        **measures,
        "views": _view_figures(setup, evaluator),
        "trajectory": _trajectory_figures(shipped, slider, record),
        **_record_figures(record),
        "paint": paint.figures() if paint is not None else None,
        **carry_figures(setup, trajectory, record.effort, folder.behind),
        **measure_above(setup, gdf, options.views.pictures, log.say),
        "time": {**(_earlier_seconds(folder) if log.refits else {}), **log.rounded_seconds()},
        "memory_mb": log.peak_mb(),
        "plan": to_json(options),
    }
    return _write_run(folder, gdf, report, picture, shipped, setup, paint, log)


def _build_gdf(options: TrainOptions, setup: TrainingSetup, field: BakedField, added: Gaussians) -> Gdf:
    """Return the edit without its report and without discs for paint finer than the Gaussians."""
    plan = to_json(options if len(added) else with_values(options, grow=0.0))
    changed_options = differences(plan, DEFAULTS)
    scene_print = fingerprint(setup.scene)
    instruction = options.editor.editor
    rows = added if len(added) else None
    gdf = Gdf(options.name, setup.region, field, scene_print, instruction, changed_options, added=rows)
    return anchor_added(gdf, setup.scene)


def _on_original(gdf: Gdf, setup: TrainingSetup) -> Gdf:
    """Return an edit of the setup's scene as an edit of the original."""
    return gdf if setup.lower is None else setup.lower.rebase(gdf)


def _view_figures(setup: TrainingSetup, evaluator: Evaluator) -> dict[str, Any]:
    """Return the views that measure the edit, choose its field and measure the field, for report.json."""
    choosing, reporting = evaluator.halves()
    return {
        "held_out": bool(setup.held_out),
        "edit": list(evaluator.names),
        "field_chosen": list(choosing.names),
        "field": list(reporting.names),
        "lpips_over": _LPIPS_AREA,
    }


def _trajectory_figures(shipped: Trajectory, slider: str, record: RunRecord) -> dict[str, Any]:
    """Return the figures of the recordings, on the final slider, for report.json."""
    return {
        "recordings": len(shipped),
        "slider": slider,
        "s": [round(float(s), 4) for s in shipped.s],
        "stages": list(shipped.strengths),
        "stages_at": [round(s, 4) for s, _ in shipped.stage_strengths],
        "attribute_worth_db": record.attribute_worth_db,
    }


def _choice_line(fitted: Fitted, size: float, recordings: int, views: int) -> str:
    """Return the log line of the chosen field: the reason, its size, and its distance to the recordings.

    `size`: bytes per Gaussian
    """
    chosen = fitted.chosen
    return (
        f"{chosen.label}, {fitted.choice.why}: {size:.0f} bytes per Gaussian without "
        f"the header, worst {chosen.worst:.1f} dB, mean {chosen.mean:.1f} dB against {recordings} recordings "
        f"in {format_count(views, 'view')}"
    )


def _fit_field(
    plan: TrainOptions,
    setup: TrainingSetup,
    evaluator: Evaluator,
    trajectory: Trajectory,
    perceptual: Perceptual,
    log: RunLog,
    folder: RunFolder,
    begun: Saved | None,
) -> tuple[Fitted, NetworkFit | None]:
    """Fit the requested field; also return the network fit if the field is a network."""
    options = plan.field
    choosing, reporting = evaluator.halves()
    if len(setup.held_out) == 1:
        log.say("only one view is held out, so the field is both chosen and reported on it")
    if not setup.held_out:
        log.say("no view is held out; all figures are measured on the training views")
    weighing = setup.train[::_VISIBILITY_STRIDE]
    with log.looks("weigh the members", len(weighing)) as count_view:
        members = setup.region.members
        scene = setup.scene
        if trajectory.added is not None:
            count = len(trajectory.added)
            scene = scene.replace_rows(members[-count:], end_rows(setup, trajectory)[-count:])
        weights = visibility(scene, members, weighing, count_view)
    rank_views = setup.train[:: max(1, len(setup.train) // _RANK_VIEWS)][:_RANK_VIEWS]
    if options.field == "neural":
        rank_evaluator = load_evaluator(folder, setup, rank_views, trajectory)
        settings = METHODS[plan.preset].network_settings(options)
        network = fit_network(
            trajectory,
            setup,
            rank_evaluator,
            reporting,
            weights,
            options,
            settings,
            perceptual=perceptual,
            log=log,
            begun=begun,
        )
        return evaluate_field(trajectory, reporting, network.field, options.target_psnr), network
    with log.looks("fit the field", expected_renders(trajectory, options.field)) as count_view:
        choosing = replace(choosing, looked=count_view)
        reporting = replace(reporting, looked=count_view)
        if trajectory.maps is not None and options.field == "auto":
            scene = setup.scene[setup.region.members]
            rows = pack(scene, with_shN=scene.sh_degree > 0)
            return fit_grades(trajectory, rows, choosing, reporting, weights, options), None
        rank_evaluator = replace(load_evaluator(folder, setup, rank_views, trajectory), looked=count_view)
        return fit_field(trajectory, rank_evaluator, choosing, reporting, weights, options), None


def write_finals(setup: TrainingSetup, edited: Gaussians, folder: RunFolder, log: RunLog) -> None:
    """Render and write the views of the finished edit."""
    with log.looks("picture the edit", len(setup.views)) as count_view:

        def draw(view: View) -> tuple[str, Tensor]:
            picture = render_view(edited, view.camera, setup.background)
            count_view()
            return view.camera.name, picture

        finals = dict(map_threads(draw, setup.views))
    write_views(folder, "final", finals)


def _measure_paint(
    folder: RunFolder, setup: TrainingSetup, files: Sequence[Path], edited: Gaussians
) -> PaintReproduction | None:
    """Return the share of the pictures' paint that the edit reproduces; None for edits not made from
    pictures."""
    if not files:
        return None
    pictures = read_views(folder, "edited", [view.camera for view in setup.train], 1.0)
    backgrounds = [  # a refit may come after the pictures were deleted
        picture_background(setup.scene, file, view.camera) if file.is_file() else setup.background
        for file, view in zip(files, setup.train, strict=True)
    ]
    return measure_paint(setup, pictures, backgrounds, edited)


def _record_figures(record: RunRecord) -> dict[str, Any]:
    """Return the part of the run's record that the report repeats."""
    names = ("objective", "losses", "kind", "kind_trial", "agreement", "up", "effort")
    return {**{name: getattr(record, name) for name in names}, "pictures": dict(record.pictures)}


def differences(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that differ from the defaults."""
    return {
        name: differences(value, defaults[name]) if isinstance(value, dict) else value
        for name, value in values.items()
        if value != defaults[name]
    }


def _write_run(
    folder: RunFolder,
    gdf: Gdf,
    report: dict[str, Any],
    picture: Tensor,
    trajectory: Trajectory,
    setup: TrainingSetup,
    paint: PaintReproduction | None,
    log: RunLog,
) -> RunResult:
    """Write the files of the run and log its main figures."""
    # the .gdf holds the options separately, stays small, and is identical for identical training
    gdf = replace(gdf, report={k: v for k, v in report.items() if k not in _KEYS_OF_REPORT_ONLY})
    result = replace(write_result(folder, gdf, report, picture), trajectory=trajectory)
    if result.gdf != folder.draft:
        folder.draft.unlink(missing_ok=True)
    edit = report["edit"]
    log.say(
        f"{setup.judged_on}: {edit['psnr_to_views']} dB, at edges {edit['edge_psnr_to_views']} dB, "
        f"{edit['perceptual']} {edit['lpips_to_views']}"
        + "".join(
            f"; s={float(s):.3g} {e['psnr']} dB (2 keyframes {e['keyframes2']})"
            for s, e in report["between"].items()
        )
    )
    each = report["file"]["bytes_per_gaussian"]
    log.say(f"{result.line}, {each:.0f} bytes per Gaussian in total")
    if paint is not None:
        log.say(f"warning: {paint.warning}" if paint.warning else paint.summary)
    return result


def write_result(folder: RunFolder, gdf: Gdf, report: dict[str, Any], picture: Tensor) -> RunResult:
    """Write NAME.gdf, report.json including the size of the .gdf, and report.png."""
    path = folder.gdf(gdf.name)
    save_gdf(path, gdf)
    size = path.stat().st_size
    report["file"] = {"bytes": size, "bytes_per_gaussian": round(size / max(1, gdf.members), 1)}
    write_json(folder.report, report)
    write_image(folder.picture, picture)
    return RunResult(folder, path, report)


def load_evaluator(
    folder: RunFolder,
    setup: TrainingSetup,
    views: Sequence[View],
    trajectory: Trajectory,
    gdf: Gdf | None = None,
) -> Evaluator:
    """Return an evaluator of some views with the edited pictures of the run.

    `gdf`: an edit that may add rows
    """
    cameras = [view.camera for view in views]
    edited = {s: read_views(folder, "edited", cameras, s) for s in trajectory.strengths}
    scene = setup.scene
    region = setup.region
    channels = trajectory.end.shape[1]
    still = only_recolors(trajectory.offsets)
    if gdf is not None and gdf.added is not None:
        scene, (gdf,) = extend(scene, [gdf])
        region = gdf.region
        channels = gdf.field.channels
        still = False
    return make_evaluator(scene, region, views, edited, setup.background, channels, still)


def end_rows(setup: TrainingSetup, trajectory: Trajectory) -> Tensor:
    """Return the raw member rows of the finished edit: original + end, in float32. [M,C]"""
    rows = pack(setup.scene[setup.region.members], with_shN=trajectory.end.shape[1] > BASE_CHANNELS)
    return rows + trajectory.end


def exactness(scene: Gaussians, gdf: Gdf, end: Tensor) -> tuple[float, float]:
    """Return the largest difference of the edit at s = 1 from the recorded end, and outside the region.

    Both are differences of raw parameters. The second is the change of Gaussians that must not change.
    """
    outside = ~gdf.region.mask
    finished = edited_scene(scene, gdf)
    members = torch.cat([gdf.region.members, torch.arange(len(scene), len(finished))])
    packed = pack(finished[members], with_shN=end.shape[1] > BASE_CHANNELS)
    endpoint = float((packed - end).abs().max())
    change = 0.0
    for s in (0.3, 1.0):
        edited = edited_scene(scene, gdf, s)
        for name in ATTRIBUTES:
            before = getattr(scene, name)[outside]
            after = getattr(edited, name)[: len(scene)][outside]
            if before.numel() and not torch.equal(before, after):
                change = max(change, float((after - before).abs().max()))
    return endpoint, change


def _earlier_seconds(folder: RunFolder) -> dict[str, float]:
    """Return the seconds of the stages that a refit does not repeat."""
    try:
        stages = decode_json(folder.report.read_bytes())["time"]
        return {str(stage): figure for stage, figure in stages.items() if isinstance(figure, int | float)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def load_result(folder: RunFolder, name: str, scene: Gaussians, log: RunLog) -> RunResult:
    """Return the result of a finished run."""
    path = folder.gdf(name)
    gdf = load_gdf(path, scene)
    trajectory = None
    if folder.trajectory.is_file():
        recorded, _, _ = load_trajectory(folder.trajectory)
        trajectory = replace(recorded, s=torch.tensor(gdf.field.recorded))
    log.say(f"{folder.root} is finished: there is nothing left to do, and {path} is complete")
    try:
        report = convert_json(decode_json(folder.report.read_bytes()), dict[str, Any])
    except ValueError as error:
        raise ProgdfError(f"{folder.report} is damaged ({error}); train again without --resume") from error
    return RunResult(folder, path, report, trajectory)


def refit(options: FitOptions, quiet: bool = False) -> RunResult:
    """Fit the field of a finished run again and rewrite its .gdf and report, without optimization.

    Raises:
        ProgdfError: the folder is not a finished run, or its scene is missing or different.
    """
    check_field_options(options.field)
    use_threads(options.threads)
    run = reopen_run(options.run, options.scene)
    log = RunLog(run.folder.log, quiet, refits=True)
    try:
        with log.stage("views"):
            setup = render_edited_views(run)
        perceptual, warning = perceptual_loss()
        if warning:
            log.say(warning)
        recorded_plan = run.record.plan
        field = replace(
            options.field,
            draft=recorded_plan.field.draft,
            seed=recorded_plan.field.seed,
        )
        texts = effective_texts(options.texts, recorded_plan.texts)
        plan = replace(recorded_plan, field=field, texts=texts)
        record = replace(run.record, plan=plan)
        return finish_run(run.folder, setup, run.trajectory, record, perceptual, log)
    finally:
        log.close()


def effective_texts(typed: TextOptions, recorded: TextOptions) -> TextOptions:
    """Return the texts for CLIP: the command's own, or the run's."""
    return TextOptions(
        typed.text_before or recorded.text_before,
        typed.text_after or recorded.text_after,
        recorded.asked or bool(typed.text_before or typed.text_after),
    )
