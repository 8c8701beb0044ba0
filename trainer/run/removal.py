"""A run that takes its region away: nothing is optimized; the course is known, and holes are closed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, concatenate
from progdf.gdf.file import Gdf
from progdf.io.images import contact_sheet
from progdf.io.json_values import plain
from progdf.metrics.image import decibels
from progdf.rasterize import render
from progdf.region import Region, from_mask
from progdf.scene.strays import find_strays
from progdf.terminal import format_count
from progdf.tidy import Step, tidy
from trainer.editors.pictures import picture_background, picture_paths, read_edit, strengths_of
from trainer.fill import Fill, fill_holes
from trainer.options import TrainOptions
from trainer.resolve import recorded_options
from trainer.setup import TrainingSetup, make_training_setup
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, write_views
from trainer.views.view import View, render_view

from .finish import DEFAULTS, RunResult, differences, write_result

BACKGROUNDS = ("white", "black", "checker")
_ALIKE = 0.05  # of color, as what was painted is told from what was not
_PAINTED = 2 / 255
_TILES = 16  # across a picture
_STEPS = 20


def is_removal(options: TrainOptions, setup: TrainingSetup, log: RunLog) -> bool:
    """Whether the run takes its region away; of changed pictures, what they show decides. Says so in a line.

    Recoloring can meet any paint, also what shows behind the region: that it does says nothing. That most of
    what was painted is what the scene shows without the region would be a coincidence.

    Args:
        options: resolved
        setup: of changed pictures, with their views
        log: of the run
    """
    editor = options.editor
    if editor.family == "remove":
        return True
    if editor.family != "pictures" or editor.removal == "never":
        return False
    one_strength = all(len(strengths_of(path)) == 1 for path in options.views.pictures)
    if editor.removal == "always" and not one_strength:
        raise ProgdfError(
            "--removal always takes the finished edit alone; give no pictures of other strengths"
        )
    share = vanished_share(setup, options) if one_strength else 0.0
    removes = editor.removal == "always" or share > 0.5
    if removes or share > 0.0:
        log.say(
            f"{100 * share:.0f} % of what was painted is what the scene shows without the region: it is "
            + (
                "taken away (--removal never recolors it)"
                if removes
                else "recolored (--removal always removes)"
            )
        )
    return removes


def vanished_share(setup: TrainingSetup, options: TrainOptions) -> float:
    """How much of the painted change, of its energy, is what the scene shows without the region. 0..1

    Args:
        setup: of the changed pictures, in their order
        options: which these are
    """
    scene = setup.scene
    rest = setup.scene[~setup.region.mask]
    change = behind = 0.0
    for view, path in zip(setup.train, options.views.pictures, strict=True):
        target = read_edit(scene, view.camera, view.image, path)
        background = picture_background(scene, path, view.camera)
        original, gone = (render_view(some, view.camera, background).clamp(0, 1) for some in (scene, rest))
        apart = target - view.image
        energy = apart.square().sum(dim=2) * (apart.abs().amax(dim=2) > _PAINTED)
        alike = (original + apart - gone).abs().amax(dim=2) < _ALIKE
        change += float(energy.sum())
        behind += float(energy[alike].sum())
    return behind / change if change else 0.0


def remove_region(options: TrainOptions, setup: TrainingSetup, folder: RunFolder, log: RunLog) -> RunResult:
    """Take the region away, close the holes, measure, and write NAME.gdf, report.json and report.png.

    Args:
        options: resolved
        setup: scene, region, and views: of a rig or of given cameras, or those of changed pictures
        folder: of the run
        log: of the run
    """
    scene = setup.scene
    chosen = len(setup.region)
    setup = replace(setup, region=with_crumbs(scene, setup.region))
    region = setup.region
    rest = scene[~setup.region.mask]
    if len(region) > chosen:
        log.say(f"{format_count(len(region) - chosen, 'Gaussian')} that would float alone without it go too")
    with log.stage("fill"):
        painted, pictures = _painted_views(options, setup)
        around = setup if not options.views.pictures else _views_around(options, setup)
        kind = options.editor.fill or ("picture" if pictures else "surface")
        views = [*painted, *(view for view in around.train if view.camera.name not in pictures)]
        fill = Fill(None, 0, 0, 0)
        if kind != "none" and len(rest):
            fill = fill_holes(scene, rest, views, pictures if kind == "picture" else None)
    rows = 0 if fill.rows is None else len(fill.rows)
    log.say(
        f"holes: none is filled, as asked ({kind})"
        if kind == "none"
        else f"holes: {fill.before} pixels in {format_count(len(views), 'view')}, {fill.after} after "
        f"{format_count(rows)} from {format_count(fill.views, 'view')} ({kind})"
    )
    with log.stage("report"):
        gdf = tidy(scene, [Step("remove", region)], options.name, options.editor.editor, fill.rows)
        removed = rest if fill.rows is None else concatenate([rest, fill.rows])
        judging = around.judging
        errors = _measure(edited_scene(scene, gdf), removed, judging)
        report = {
            "edit": {"psnr_to_views": min(errors.values()), "psnr_by_background": errors},
            "removal": {
                "members": len(region),
                "opacity_off_linear": round(_off_linear(scene, gdf), 4),
                "fill": kind,
                "rows_added": rows,
                "filled_from_views": fill.views,
                "hole_pixels": fill.before,
                "hole_pixels_after": fill.after,
                "psnr_to_pictures": _picture_error(setup, removed, painted, pictures),
            },
            "views": {"held_out": bool(around.held_out), "edit": [view.camera.name for view in judging]},
            "time": log.rounded_seconds(),
            "memory_mb": log.peak_mb(),
            "plan": plain(recorded_options(options)),
        }
        picture = _sheet(scene, gdf, judging, f"{options.name}: {options.editor.editor}")
    finals = {view.camera.name: render_view(removed, view.camera, setup.background) for view in setup.views}
    write_views(folder, "final", finals)
    folder.trajectory.unlink(missing_ok=True)  # of an earlier run that recolored
    about = {name: report[name] for name in ("edit", "removal")}
    gdf = replace(gdf, options=differences(report["plan"], DEFAULTS), report=about)
    result = write_result(folder, gdf, report, picture)
    said = ", ".join(f"{psnr:.1f} dB on {name}" for name, psnr in errors.items())
    log.say(f"to a render without the region, at its pixels in views not filled from: {said}")
    log.say(f"{result.line}; shadows and reflections stay")
    return result


def with_crumbs(scene: Gaussians, region: Region) -> Region:
    """The region, and the floaters that taking it away leaves of its surroundings; see `find_strays`."""
    mask = ~region.mask
    alone = mask.nonzero()[:, 0][find_strays(scene[mask]).floaters]
    mask[alone[~torch.isin(alone, torch.from_numpy(find_strays(scene).floaters))]] = False
    return from_mask(region.name, ~mask)


def _painted_views(options: TrainOptions, setup: TrainingSetup) -> tuple[list[View], Mapping[str, Tensor]]:
    """Views of the pictures that show what was behind, and these by name, as the views would be. [H,W,3]"""
    what = options.editor.editor.partition(":")[2]
    if not what:
        return [], {}
    paths = options.views.pictures or picture_paths(what)
    if not options.views.pictures:
        setup = make_training_setup(replace(options.views, pictures=paths), setup.scene, setup.region)
    pairs = list(zip(setup.train, paths, strict=True))
    return [view for view, _ in pairs], {
        v.camera.name: read_edit(setup.scene, v.camera, v.image, path) for v, path in pairs
    }


def _views_around(options: TrainOptions, setup: TrainingSetup) -> TrainingSetup:
    """Views from all around beside those of the pictures; these alone where there are none to be had."""
    try:
        return make_training_setup(replace(options.views, pictures=()), setup.scene, setup.region)
    except ProgdfError:
        return setup


def _measure(edited: Gaussians, reference: Gaussians, views: Sequence[View]) -> dict[str, float]:
    """PSNR at the region's pixels of all views together, by background, dB."""
    errors = dict.fromkeys(BACKGROUNDS, 0.0)
    count = 0
    for view in views:
        pixels = view.mask > _ALIKE
        count += 3 * int(pixels.sum())
        pairs = zip(on_backgrounds(edited, view.camera), on_backgrounds(reference, view.camera), strict=True)
        for name, (a, b) in zip(BACKGROUNDS, pairs, strict=True):
            errors[name] += float((a - b)[pixels].double().square().sum())
    return {name: round(decibels(error / max(1, count)), 2) for name, error in errors.items()}


def on_backgrounds(scene: Gaussians, camera: Camera) -> list[Tensor]:
    """The scene on each of `BACKGROUNDS`. [H,W,3] each"""
    with torch.no_grad():
        drawn = render(scene, camera, (0.0, 0.0, 0.0))
    side = max(1, max(camera.width, camera.height) // _TILES)
    rows = torch.arange(camera.height)[:, None] // side
    columns = torch.arange(camera.width) // side
    checker = ((rows + columns) % 2).float()
    shades = (torch.ones_like(checker), torch.zeros_like(checker), checker)
    return [(drawn.image + (drawn.transmittance * shade)[..., None]).clamp(0.0, 1.0) for shade in shades]


def _off_linear(scene: Gaussians, gdf: Gdf) -> float:
    """By how much the sum of the region's opacities is off a straight line, as a share of it, at worst."""
    members = gdf.region.members
    whole = float(scene.opacities[members].sum())
    off = [0.0]
    for i in range(1, _STEPS + 1):
        s = i / _STEPS
        now = edited_scene(scene, gdf, s).opacities[members].sum()
        off.append(abs(float(now) / whole - (1.0 - s)))
    return max(off)


def _picture_error(
    setup: TrainingSetup, removed: Gaussians, views: Sequence[View], pictures: Mapping[str, Tensor]
) -> float | None:
    """PSNR to the pictures at what was painted, dB; None where there are none."""
    error = count = 0.0
    for view in views:
        target = pictures[view.camera.name]
        painted = (target - view.image).abs().amax(dim=2) > _PAINTED
        made = render_view(removed, view.camera, setup.background).clamp(0.0, 1.0)
        error += float((made - target)[painted].square().sum())
        count += 3 * int(painted.sum())
    return round(decibels(error / count), 2) if count else None


def _sheet(scene: Gaussians, gdf: Gdf, views: Sequence[View], title: str) -> Tensor:
    """The view that shows most of the region, at five strengths on three backgrounds."""
    view = max(views, key=lambda one: float(one.mask.sum()))
    strengths = (0.0, 0.25, 0.5, 0.75, 1.0)
    columns = [on_backgrounds(edited_scene(scene, gdf, s), view.camera) for s in strengths]
    rows = [list(row) for row in zip(*columns, strict=True)]
    return contact_sheet(
        rows, BACKGROUNDS, [f"s = {s:g}" for s in strengths], title, f"view {view.camera.name}"
    )
