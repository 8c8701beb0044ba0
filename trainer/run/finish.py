"""End of a run: fit the field and deliver NAME.gdf, then measure it for report.json and report.png."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from progdf.gdf.file import Gdf, anchor_added, fingerprint, load_gdf, save_gdf
from progdf.io.images import write_image
from progdf.io.json_values import convert_json, decode_json, to_json
from progdf.terminal import file_size, format_count
from trainer.fit.delivered import DeliveredEdit, save_delivered
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.fit.fit import Fitted, evaluate_field, expected_renders, fit_field, visibility
from trainer.fit.grades import fit_grades
from trainer.fit.network import NetworkFit, fit_network
from trainer.fit.slider_uniformity import equalize_slider
from trainer.methods import METHODS
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.optimize.retime import resolve_slider
from trainer.options import FitOptions, ReportLevel, TextOptions, TrainOptions, with_values
from trainer.regions.from_pictures import CHANGED
from trainer.report.measures import (
    Direction,
    PaintReproduction,
    against_editor,
    carry_figures,
    clip_curve,
    delivered_figures,
    exactness,
    expected_measures,
    measure,
    measure_above,
    measure_paint,
    measured_figures,
    picture_backgrounds,
)
from trainer.report.report import report_picture
from trainer.resolve import BLANK, check_field_options, prepare_process
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, read_views, write_json
from trainer.store.state import Saved
from trainer.views.crops import only_recolors
from trainer.views.setup import TrainingSetup
from trainer.views.view import View

from .paint import sharpen
from .record import FinishedRun, RunRecord, render_edited_views, reopen_run, write_finals

_RANK_VIEWS = 4  # number of training views on which the rank of a field is chosen
_VISIBILITY_STRIDE = 2  # every second training view measures the visibility of the members
_KEYS_OF_REPORT_ONLY = (
    *("report", "plan", "views", "pictures"),
    *("losses", "trajectory", "effort", "choice", "baselines"),
)
DEFAULTS = to_json(BLANK)

RECORDED = "recorded"
"""Part of the saved state with the seconds of the finished stages, from the recording on."""

_LPIPS_AREA = "each view's box around the region and all edited pixels, at least 64 pixels per side"


@dataclass(frozen=True)
class RunResult:
    """Output of a run."""

    folder: RunFolder
    gdf: Path
    report: dict[str, Any]  # content of report.json
    # the recordings, at the slider values at which the field reproduces them; None for edits without training
    trajectory: Trajectory | None = None

    @property
    def line(self) -> str:
        """Log line with the written file and its size."""
        return f"wrote {self.gdf}: {file_size(self.report['file']['bytes'])}"


@dataclass(frozen=True)
class ReportRequest:
    """Extent of the report after the delivery of an edit."""

    level: ReportLevel = "full"
    on_delivery: Callable[[], None] = lambda: None  # called once NAME.gdf is written, before the report


FULL_REPORT = ReportRequest()
"""Default request."""


def finish_run(
    folder: RunFolder,
    setup: TrainingSetup,
    trajectory: Trajectory,
    record: RunRecord,
    perceptual: Perceptual,
    log: RunLog,
    begun: Saved | None = None,
    request: ReportRequest = FULL_REPORT,
) -> RunResult:
    """Fit the field and deliver NAME.gdf, then write the report, see `report_run`.

    Args:
        folder: folder of the run
        setup: scene, region, views
        trajectory: the recordings
        record: see `RunRecord`; its plan selects the field, and the report repeats the remainder
        perceptual: image distance
        log: log of the run
        begun: see `network.fit_network`
        request: extent of the report, and a callback at the delivery
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
    log.say(_choice_line(fitted, field.bytes_per_member, len(trajectory), len(reporting.names)))
    with log.stage("deliver"):
        gdf = _build_gdf(options, setup, field, grown.scene[len(scene) :])
        pairs = zip(options.views.pictures, setup.train, strict=False)
        pictures = {path: view.camera for path, view in pairs}
        sharpened = sharpen(scene, gdf, pictures, options.region.region != CHANGED, log, setup.seen)
        endpoint, outside = exactness(scene, gdf, end_rows(grown, trajectory))
        edit = DeliveredEdit.of(gdf, sharpened, trajectory, remap, fitted)
        displayed = evaluator
        if sharpened is not None:
            gdf = sharpened
            displayed = load_evaluator(folder, setup, setup.judging, trajectory, gdf)
        edited = edited_scene(scene, gdf)
        if sharpened is not None:
            write_finals(setup, edited, folder, log)
        psnr = displayed.psnr(displayed.course(gdf.field)(1.0), displayed.edited[trajectory.strengths[-1]])
        paint = _measure_paint(folder, setup, options.views.pictures, edited)
        figures = delivered_figures(fitted, gdf.field, endpoint, outside, psnr)
        gdf = _on_original(gdf, setup)
        if network is not None:
            figures["field"] |= network.figures()
        report = {
            "report": "none",
            **figures,
            "views": _view_figures(setup, evaluator),
            "trajectory": _trajectory_figures(edit.shipped_trajectory, slider, record),
            **_record_figures(record),
            "paint": paint.figures() if paint is not None else None,
            **carry_figures(setup, trajectory, record.effort, folder.behind),
            **measure_above(setup, gdf, options.views.pictures, log.say),
            "plan": to_json(options),
        }
    earlier = _earlier_seconds(folder) if log.refits else {}
    result = replace(
        _deliver(folder, gdf, report, setup, paint, log, earlier), trajectory=edit.shipped_trajectory
    )
    if not log.refits:
        save_delivered(folder.state, edit)
        folder.state.save(RECORDED, {}, log.capture_state().values)
    request.on_delivery()
    views = evaluator, displayed
    return report_run(result, edit, setup, record, perceptual, log, request.level, views)


def report_run(
    result: RunResult,
    edit: DeliveredEdit,
    setup: TrainingSetup,
    record: RunRecord,
    perceptual: Perceptual,
    log: RunLog,
    level: ReportLevel,
    views: tuple[Evaluator, Evaluator] | None = None,
) -> RunResult:
    """Measure a delivered edit, and write the report: report.json and report.png.

    The report never changes NAME.gdf. If it is stopped, report.json has the figures known at the delivery.

    Args:
        result: the delivered edit, with its report so far and its recordings
        edit: see `DeliveredEdit`
        setup, record: see `finish_run`
        perceptual: image distance
        log: log of the run
        level: extent of the report
        views: evaluators of the edit without and with the discs for fine paint; None: made here
    """
    if level == "none":
        return result
    options = record.plan
    grown = setup.extend(edit.trajectory.added)
    is_even = resolve_slider(options.optimize.slider, edit.trajectory.strengths) == "even"
    if views is None:
        plain = load_evaluator(result.folder, grown, setup.judging, edit.trajectory)
        sharp = edit.sharpened
        views = plain, plain
        if sharp is not None:
            views = plain, load_evaluator(result.folder, setup, setup.judging, edit.trajectory, sharp)
    evaluator, displayed = views
    earlier = result.report["time"]
    with log.stage("report"):
        is_full = level == "full"
        distance = perceptual if is_full else None
        clip = Direction(reason="the report is short")
        if is_full:
            clip = clip_curve(evaluator, setup.judging, edit.gdf.field, options.texts)
            if clip.reason and options.texts.asked:
                log.say(f"CLIP directional similarity is not measured: {clip.reason}")
        with log.looks("measure the edit", expected_measures(edit.trajectory)) as count_view:
            _, reporting = evaluator.halves()
            judges = replace(evaluator, looked=count_view), replace(reporting, looked=count_view)
            measured = measure(judges, grown, edit, is_even, distance, clip)
        if edit.sharpened is not None:
            field = edit.sharpened.field
            slider_measures = against_editor(displayed, {"slider": field}, measured.asked, distance, most=1)
            measured = replace(measured, shown=field, editor={**measured.editor, **slider_measures})
        picture = None
        if is_full:
            title = f"{options.name}: {options.editor.editor}"
            count = len(setup.held_out)
            picture = report_picture(evaluator, displayed, measured, record.losses, title, count)
    report = _with_measures(result.report, measured_figures(measured)) | {"report": level}
    return _write_report(result, report, picture, log, earlier)


def read_report(folder: RunFolder) -> dict[str, Any]:
    """Return the content of a run's report.json.

    Raises:
        ProgdfError: it is damaged.
    """
    try:
        return convert_json(decode_json(folder.report.read_bytes()), dict[str, Any])
    except ValueError as error:
        raise ProgdfError(f"{folder.report} is damaged ({error}); train again without --resume") from error


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
        return evaluate_field(trajectory, reporting, network.field, options), network
    with log.looks("fit the field", expected_renders(trajectory, options.field)) as count_view:
        choosing = replace(choosing, looked=count_view)
        reporting = replace(reporting, looked=count_view)
        if trajectory.maps is not None and options.field == "auto":
            scene = setup.scene[setup.region.members]
            rows = pack(scene, with_shN=scene.sh_degree > 0)
            return fit_grades(trajectory, rows, choosing, reporting, weights, options), None
        rank_evaluator = replace(load_evaluator(folder, setup, rank_views, trajectory), looked=count_view)
        return fit_field(trajectory, rank_evaluator, choosing, reporting, weights, options), None


def _measure_paint(
    folder: RunFolder, setup: TrainingSetup, files: Sequence[Path], edited: Gaussians
) -> PaintReproduction | None:
    """Return the share of the pictures' paint that the edit reproduces; None for edits not made from
    pictures."""
    if not files:
        return None
    pictures = read_views(folder, "edited", [view.camera for view in setup.train], 1.0)
    return measure_paint(setup, pictures, picture_backgrounds(setup, files), edited)


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


def _with_measures(report: Mapping[str, Any], measures: Mapping[str, Any]) -> dict[str, Any]:
    """Return a report with further figures; field, edit and baselines keep their own and gain these."""
    joined = {name: {**report[name], **measures[name]} for name in ("field", "edit", "baselines")}
    return {**report, **measures, **joined}


def _deliver(
    folder: RunFolder,
    gdf: Gdf,
    report: dict[str, Any],
    setup: TrainingSetup,
    paint: PaintReproduction | None,
    log: RunLog,
    earlier: Mapping[str, float],
) -> RunResult:
    """Write NAME.gdf and a report with the figures known so far, and log them."""
    # the .gdf holds the options separately, stays small, and is identical for identical training
    gdf = replace(gdf, report={k: v for k, v in report.items() if k not in _KEYS_OF_REPORT_ONLY})
    report = report | {"time": {**earlier, **log.rounded_seconds()}, "memory_mb": log.peak_mb()}
    result = write_result(folder, gdf, report)
    if result.gdf != folder.draft:
        folder.draft.unlink(missing_ok=True)
    each = result.report["file"]["bytes_per_gaussian"]
    psnr = report["edit"]["psnr_to_views"]
    log.say(f"{gdf.name} is ready; {setup.judged_on}: {psnr} dB, {each:.0f} bytes per Gaussian in total")
    log.say(result.line)
    if paint is not None:
        log.say(f"warning: {paint.warning}" if paint.warning else paint.summary)
    return result


def _write_report(
    result: RunResult,
    report: dict[str, Any],
    picture: Tensor | None,
    log: RunLog,
    earlier: Mapping[str, float],
) -> RunResult:
    """Complete the report of a delivered edit, and log its main figures."""
    report |= {
        "time": {**earlier, **log.rounded_seconds()},
        "memory_mb": log.peak_mb(),
        "file": result.report["file"],
    }
    write_json(result.folder.report, report)
    if picture is not None:
        write_image(result.folder.picture, picture)
    edit = report["edit"]
    parts = [f"at edges {edit['edge_psnr_to_views']} dB"]
    if "perceptual" in edit:
        parts[0] += f", {edit['perceptual']} {edit['lpips_to_views']}"
    for s, between in report["between"].items():
        parts.append(f"s={float(s):.3g} {between['psnr']} dB (2 keyframes {between['keyframes2']})")
    log.say(f"{report['report']} report in {result.folder.report}: {'; '.join(parts)}")
    return replace(result, report=report)


def write_result(
    folder: RunFolder, gdf: Gdf, report: dict[str, Any], picture: Tensor | None = None
) -> RunResult:
    """Write NAME.gdf, report.json including the size of the .gdf, and report.png.

    Without a picture, a report.png of an earlier run is removed.
    """
    path = folder.gdf(gdf.name)
    save_gdf(path, gdf)
    size = path.stat().st_size
    report["file"] = {"bytes": size, "bytes_per_gaussian": round(size / max(1, gdf.members), 1)}
    write_json(folder.report, report)
    if picture is None:
        folder.picture.unlink(missing_ok=True)
    else:
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
    report = read_report(folder)
    log.say(f"{folder.root} is finished: there is nothing left to do, and {path} is complete")
    return RunResult(folder, path, report, trajectory)


def refit(options: FitOptions, quiet: bool = False) -> RunResult:
    """Fit the field of a finished run again and rewrite its .gdf and report, without optimization.

    Raises:
        ProgdfError: the folder is not a finished run, or its scene is missing or different.
    """
    check_field_options(options.field)
    prepare_process(options.threads)
    run = reopen_run(options.run, options.scene)
    recorded_plan = run.record.plan
    field = replace(
        options.field,
        draft=recorded_plan.field.draft,
        seed=recorded_plan.field.seed,
    )
    texts = effective_texts(options.texts, recorded_plan.texts)
    plan = replace(recorded_plan, field=field, texts=texts)
    record = replace(run.record, plan=plan)
    return _finish_again(replace(run, record=record), quiet, ReportRequest(options.report))


def complete_report(root: Path, scene: Path, quiet: bool, request: ReportRequest) -> RunResult:
    """Write the report of a finished run that has a shorter one. The edit stays the same.

    Args:
        root: folder of the run
        scene: path of its scene
        quiet: no output on the screen
        request: see `finish_run`

    Raises:
        ProgdfError: see `reopen_run`.
    """
    return _finish_again(reopen_run(root, scene), quiet, request)


def _finish_again(run: FinishedRun, quiet: bool, request: ReportRequest) -> RunResult:
    """Fit the field of a finished run by its record, and write the edit and its report."""
    log = RunLog(run.folder.log, quiet, refits=True)
    try:
        with log.stage("views"), log.steps("views", 1):
            setup = render_edited_views(run)
        perceptual, warning = perceptual_loss()
        if warning:
            log.say(warning)
        return finish_run(run.folder, setup, run.trajectory, run.record, perceptual, log, request=request)
    finally:
        log.close()


def effective_texts(typed: TextOptions, recorded: TextOptions) -> TextOptions:
    """Return the texts for CLIP: the command's own, or the run's."""
    return TextOptions(
        typed.text_before or recorded.text_before,
        typed.text_after or recorded.text_after,
        recorded.asked or bool(typed.text_before or typed.text_after),
    )
