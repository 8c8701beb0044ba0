"""Removal of a region.

The path over strengths is known in closed form, so nothing is optimized. Holes are filled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, concatenate
from progdf.gdf.file import Gdf
from progdf.io.images import contact_sheet, write_image
from progdf.io.json_values import to_json
from progdf.metrics.image import decibels
from progdf.metrics.slider import visible_change
from progdf.region import Region, from_mask
from progdf.scene.strays import with_strays
from progdf.terminal import format_count
from progdf.threads import map_threads
from progdf.tidy import Step, tidy
from trainer.editors import editor_row
from trainer.editors.pictures import picture_background, read_edit, strengths_of
from trainer.fill.holes import Fill, OpenHoles, fill_holes, find_holes, region_weight, visible_depth
from trainer.options import ReportLevel, TrainOptions
from trainer.regions.remains import find_remains, remaining_share
from trainer.resolve import recorded_options
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, write_json, write_views
from trainer.views.setup import TrainingSetup, make_training_setup
from trainer.views.view import BACKGROUND_NAMES, View, on_backgrounds, render_view

from .finish import DEFAULTS, FULL_REPORT, ReportRequest, RunResult, differences, write_result

_TOLERANCE = 0.05  # color tolerance of equal pixels; also the mask value from which a pixel counts as region
_MIN_PAINT = 2 / 255  # smallest color change that counts as paint
_LOOKS_PER_VIEW = 6  # estimated renders of each view while a hole is filled, for the progress
_TEXTURE_WORK = 4.0  # estimated work of a textured fill, relative to choosing the views
_JUDGED_STRENGTHS = (0.25, 0.5, 0.75, 0.9)  # strengths at which the visible change is measured


def is_removal(options: TrainOptions, setup: TrainingSetup, log: RunLog) -> bool:
    """Return True if the run removes its region. For changed pictures, their content decides. Logs the
    decision.

    Recoloring can reproduce any paint, also the background behind the region, so its success is no evidence
    against removal. But if most of the paint equals the scene without the region, the pictures show a
    removal.

    Args:
        options: resolved options
        setup: changed pictures and their views
        log: log of the run
    """
    editor = options.editor
    run = editor_row(editor).run
    if run != "trained or removed":
        return run == "removed"
    if editor.removal == "never":
        return False
    one_strength = all(len(strengths_of(path)) == 1 for path in options.views.pictures)
    if editor.removal == "always" and not one_strength:
        raise ProgdfError(
            "--removal always uses only pictures of the full edit; leave out those of other strengths"
        )
    share = vanished_share(setup, options) if one_strength else 0.0
    removes = editor.removal == "always" or share > 0.5
    if removes or share > 0.0:
        decision = "removed (--removal never recolors it)"
        if not removes:
            decision = "recolored (--removal always removes it)"
        log.say(
            f"{100 * share:.0f} % of the painted change equals the scene without the region: "
            f"the region is {decision}"
        )
    return removes


def vanished_share(setup: TrainingSetup, options: TrainOptions) -> float:
    """Return the share of the painted energy that equals the scene without the region, 0 to 1.

    Args:
        setup: the changed pictures, in their order
        options: names the pictures
    """
    scene = setup.scene
    remaining = setup.scene[~setup.region.mask]
    change = behind = 0.0
    for view, path in zip(setup.train, options.views.pictures, strict=True):
        target = read_edit(scene, view.camera, view.image, path, setup.seen)
        background = picture_background(scene, path, view.camera)
        original, without_region = (
            render_view(gaussians, view.camera, background).clamp(0, 1) for gaussians in (scene, remaining)
        )
        change_of_view = target - view.image
        energy = change_of_view.square().sum(dim=2) * (change_of_view.abs().amax(dim=2) > _MIN_PAINT)
        matches = (original + change_of_view - without_region).abs().amax(dim=2) < _TOLERANCE
        change += float(energy.sum())
        behind += float(energy[matches].sum())
    return behind / change if change else 0.0


def remove_region(
    options: TrainOptions,
    setup: TrainingSetup,
    folder: RunFolder,
    log: RunLog,
    request: ReportRequest = FULL_REPORT,
) -> RunResult:
    """Remove the region, fill the holes and write NAME.gdf; then measure for report.json and report.png.

    Args:
        options: resolved options
        setup: scene, region, and views: of a rig, of given cameras, or of changed pictures
        folder: folder of the run
        log: log of the run
        request: extent of the report, and a callback at the delivery
    """
    scene = setup.scene
    named = setup.region
    log.expect({"views": 1.0, "fill": 1.0, "texture": _TEXTURE_WORK})
    with log.stage("fill"):
        painted, pictures = _painted_views(options, setup)
        around = setup if not options.views.pictures else _views_around(options, setup)
        kind = options.editor.fill or ("picture" if pictures else "surface")
        views = [*painted, *(view for view in around.train if view.camera.name not in pictures)]
        fill_pictures = pictures if kind == "picture" else None
        with log.looks("fill", _LOOKS_PER_VIEW * len(views)) as looked:
            depths = _render_each(lambda view: visible_depth(scene, view.camera), views, looked)
            close = partial(fill_holes, pictures=fill_pictures, close=kind != "none", looked=looked)
            attempt = partial(_attempt, scene, views=views, depths=depths, close=close, looked=looked)
            removal = _remove_whole(scene, named, around.train, attempt, log)
        fill = removal.fill
        if kind == "surface" and fill.rows is not None:
            with log.steps("texture", 1):
                fill = fill_holes(removal.opened, is_textured=True)
            removal = replace(removal, fill=fill)
        for note in fill.notes:
            log.say(note)
        removed = removal.scene
        remains = remaining_share(scene, removed, around.judging)
        remains_of_named = remaining_share(scene, scene[~named.mask], around.judging)
    rows_added = 0 if fill.rows is None else len(fill.rows)
    log.say(
        f"{100 * remains:.2f} % of the region's visible pixels still show its surface and color "
        f"({100 * remains_of_named:.2f} % if only the named region is removed)"
    )
    counted = f"holes: {fill.before} pixels in {format_count(len(views), 'view')}"
    log.say(
        f"{counted}; not filled, as requested"
        if kind == "none"
        else f"{counted}, {fill.after} after {format_count(rows_added)} from "
        f"{format_count(fill.views, 'view')} ({kind})"
    )
    with log.stage("deliver"):
        cameras = [view.camera for view in around.train]
        steps = [Step("remove", removal.region)]
        gdf = tidy(scene, steps, options.name, options.editor.editor, fill.rows, cameras)
        judging = around.judging
        figures: dict[str, Any] = {
            "members": len(removal.region),
            "remains_added": len(removal.region) - len(named),
            "remaining_share": round(remains, 5),
            "remaining_share_of_named": round(remains_of_named, 5),
            "fill": kind,
            "fill_notes": list(fill.notes),
            "rows_added": rows_added,
            "filled_from_views": fill.views,
            "hole_pixels": fill.before,
            "hole_pixels_after": fill.after,
            "psnr_to_pictures": _picture_error(setup, removed, painted, pictures),
        }
        report: dict[str, Any] = {
            "report": "none",
            "removal": figures,
            "views": {"held_out": bool(around.held_out), "edit": [view.camera.name for view in judging]},
            "plan": to_json(recorded_options(options)),
        }
        folder.trajectory.unlink(missing_ok=True)  # left by an earlier run that recolored
        delivered = replace(
            gdf, options=differences(report["plan"], DEFAULTS), report={"removal": dict(figures)}
        )
        delivered = delivered if setup.lower is None else setup.lower.rebase(delivered)
        report |= {"time": log.rounded_seconds(), "memory_mb": log.peak_mb()}
        result = write_result(folder, delivered, report)
        log.say(f"{options.name} is ready; shadows and reflections stay")
        log.say(result.line)
    request.on_delivery()
    drawn = map_threads(lambda view: render_view(removed, view.camera, setup.background), setup.views)
    finals = {view.camera.name: image for view, image in zip(setup.views, drawn, strict=True)}
    write_views(folder, "final", finals)
    if request.level != "none":
        title = f"{options.name}: {options.editor.editor}"
        _report_removal(result, gdf, removed, around, title, log, request.level)
    return result


def _report_removal(
    result: RunResult,
    gdf: Gdf,
    removed: Gaussians,
    around: TrainingSetup,
    title: str,
    log: RunLog,
    level: ReportLevel,
) -> None:
    """Measure a delivered removal, complete its report in place, and write report.json and report.png.

    Args:
        result: the delivered run
        gdf: the edit of the scene of `around`
        removed: the scene without the region
        around: the original, and the views to measure
        title: title of the picture
        log: log of the run
        level: short or full
    """
    scene = around.scene
    judging = around.judging
    folder = result.folder
    report = result.report
    with log.stage("report"):
        errors = _measure(edited_scene(scene, gdf), removed, judging)
        fading = _measure_fading(scene, gdf, judging)
        if level == "full":
            write_image(folder.picture, _contact_sheet(scene, gdf, judging, title))
    report["report"] = level
    report["edit"] = {"psnr_to_views": min(errors.values()), "psnr_by_background": errors}
    report["removal"] |= fading
    report["time"] = log.rounded_seconds()
    report["memory_mb"] = log.peak_mb()
    write_json(folder.report, report)
    shares = ", ".join(f"{100 * share:.0f} % at {s}" for s, share in fading["visible_change"].items())
    log.say(
        f"visible change in {around.judged_on}: {shares}; at 0.5 a pixel differs by "
        f"{fading['pixel_deviation']:.3f} on average from the mean of its ends"
    )


@dataclass(frozen=True)
class Removal:
    """Removed region and the scene that remains."""

    region: Region  # all removed Gaussians
    opened: OpenHoles
    fill: Fill

    @property
    def scene(self) -> Gaussians:
        """The scene at strength 1, with filled holes."""
        rest = self.opened.rest
        return rest if self.fill.rows is None else concatenate([rest, self.fill.rows])


def _render_each(
    render: Callable[[View], Tensor], views: Sequence[View], looked: Callable[[], None]
) -> list[Tensor]:
    """Return a picture of each view; call `looked` after each."""

    def draw(view: View) -> Tensor:
        picture = render(view)
        looked()
        return picture

    return map_threads(draw, views)


def _attempt(
    scene: Gaussians,
    region: Region,
    views: Sequence[View],
    depths: Sequence[Tensor],
    close: Callable[[OpenHoles], Fill],
    looked: Callable[[], None],
) -> Removal:
    """Remove a region and fill the holes.

    Args:
        scene: the original
        region: the Gaussians to remove
        views: views with any mask
        depths: see `find_holes`
        close: fills the holes
        looked: called after each render of a view
    """
    masks = _render_each(lambda view: region_weight(scene, region, view.camera), views, looked)
    masked = [replace(view, mask=mask) for view, mask in zip(views, masks, strict=True)]
    opened = find_holes(scene, scene[~region.mask], masked, depths, looked)
    return Removal(region, opened, close(opened))


def _remove_whole(
    scene: Gaussians,
    named: Region,
    views: Sequence[View],
    attempt: Callable[[Region], Removal],
    log: RunLog,
) -> Removal:
    """Remove the named region with what belongs to it: strays and remains. Logs them.

    Remains that the region hid completely may also be the surface below it. They go if the holes that this
    opens are closed as well as without.

    Args:
        scene: the original
        named: the named region
        views: views of the original with the region's mask
        attempt: removes a region and fills its holes
        log: log of the run
    """
    whole = with_strays(scene, named)
    if len(whole) > len(named):
        log.say(f"also removed: {format_count(len(whole) - len(named), 'Gaussian')} left floating")
    remains = find_remains(scene, whole, views)
    mask = whole.mask.index_fill(0, remains.seen, True)
    if len(remains.seen):
        log.say(
            f"also removed: {format_count(len(remains.seen), 'Gaussian')} around the region, visible only "
            "in its pixels, that touch it and have its color"
        )
    removal = attempt(from_mask(named.name, mask))
    if not len(remains.hidden):
        return removal
    larger = attempt(from_mask(named.name, mask.index_fill(0, remains.hidden, True)))
    is_closed = larger.fill.after <= removal.fill.after
    decision = "also removed" if is_closed else "kept"
    log.say(
        f"{decision}: {format_count(len(remains.hidden), 'Gaussian')} of the region's color that it hides; "
        f"holes have {larger.fill.after} pixels without them and {removal.fill.after} with them"
    )
    return larger if is_closed else removal


def _painted_views(options: TrainOptions, setup: TrainingSetup) -> tuple[list[View], Mapping[str, Tensor]]:
    """Return the views of the pictures that show the background, and these pictures by view name. [H,W,3]"""
    paths = options.views.pictures or editor_row(options.editor).files(options.editor.text)
    if not paths:
        return [], {}
    if not options.views.pictures:
        setup = make_training_setup(replace(options.views, pictures=paths), setup.scene, setup.region)
    pairs = list(zip(setup.train, paths, strict=True))
    return [view for view, _ in pairs], {
        v.camera.name: read_edit(setup.scene, v.camera, v.image, path, setup.seen) for v, path in pairs
    }


def _views_around(options: TrainOptions, setup: TrainingSetup) -> TrainingSetup:
    """Return a setup with views from all sides; the given setup, with the pictures' views, if none exist."""
    try:
        return make_training_setup(replace(options.views, pictures=()), setup.scene, setup.region)
    except ProgdfError:
        return setup


def _measure(edited: Gaussians, reference: Gaussians, views: Sequence[View]) -> dict[str, float]:
    """Return the PSNR at the region's pixels over all views, by background, dB."""
    errors = dict.fromkeys(BACKGROUND_NAMES, 0.0)
    count = 0
    for view in views:
        pixels = view.mask > _TOLERANCE
        count += 3 * int(pixels.sum())
        pairs = zip(on_backgrounds(edited, view.camera), on_backgrounds(reference, view.camera), strict=True)
        for name, (a, b) in zip(BACKGROUND_NAMES, pairs, strict=True):
            errors[name] += float((a - b)[pixels].double().square().sum())
    return {name: round(decibels(error / max(1, count)), 2) for name, error in errors.items()}


def _measure_fading(scene: Gaussians, gdf: Gdf, views: Sequence[View]) -> dict[str, Any]:
    """Return the evenness of the fading over the views and `BACKGROUND_NAMES`, for report.json.

    The visible change at some strengths is a share of that at 1. The deviation of a pixel at strength 0.5 is
    its largest color difference from the mean of its colors at 0 and 1, over the pixels that the edit
    changes.
    """

    def pictures(strength: float) -> list[Tensor]:
        edited = edited_scene(scene, gdf, strength)
        return [image for view in views for image in on_backgrounds(edited, view.camera)]

    first = pictures(0.0)
    last = pictures(1.0)
    between = {strength: pictures(strength) for strength in _JUDGED_STRENGTHS}
    whole = visible_change(first, last)
    changes = dict[str, float]()
    for strength, now in between.items():
        changes[f"{strength:g}"] = round(visible_change(first, now) / whole, 3) if whole else strength
    deviations = []
    for a, b, mid in zip(first, last, between[0.5], strict=True):
        changed = (a - b).abs().amax(dim=2) > _MIN_PAINT
        deviations.append((mid - 0.5 * (a + b)).abs().amax(dim=2)[changed])
    pixels = torch.cat(deviations)
    mean = round(float(pixels.mean()), 4) if len(pixels) else 0.0
    return {"visible_change": changes, "pixel_deviation": mean}


def _picture_error(
    setup: TrainingSetup, removed: Gaussians, views: Sequence[View], pictures: Mapping[str, Tensor]
) -> float | None:
    """Return the PSNR to the pictures in the painted pixels, dB; None if there are none."""
    error = count = 0.0
    for view in views:
        target = pictures[view.camera.name]
        painted = (target - view.image).abs().amax(dim=2) > _MIN_PAINT
        image = render_view(removed, view.camera, setup.background).clamp(0.0, 1.0)
        error += float((image - target)[painted].square().sum())
        count += 3 * int(painted.sum())
    return round(decibels(error / count), 2) if count else None


def _contact_sheet(scene: Gaussians, gdf: Gdf, views: Sequence[View], title: str) -> Tensor:
    """Return the view that shows most of the region, at five strengths on three backgrounds."""
    view = max(views, key=lambda one: float(one.mask.sum()))
    strengths = (0.0, 0.25, 0.5, 0.75, 1.0)
    columns = [on_backgrounds(edited_scene(scene, gdf, s), view.camera) for s in strengths]
    rows = [list(row) for row in zip(*columns, strict=True)]
    return contact_sheet(
        rows, BACKGROUND_NAMES, [f"s = {s:g}" for s in strengths], title, f"view {view.camera.name}"
    )
