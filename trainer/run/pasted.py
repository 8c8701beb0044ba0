"""Pasted edit: paint of views as discs on the surface. Nothing is trained."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor

from progdf.compose.reference import edited_scene
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.io.cameras import save_cameras
from progdf.io.images import contact_sheet
from progdf.io.json_values import to_json
from progdf.metrics.image import decibels, psnr
from progdf.terminal import group_digits
from trainer.editors import editor_row, make_editor
from trainer.editors.base import PastingEditor
from trainer.options import TrainOptions
from trainer.resolve import recorded_options
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, write_views
from trainer.views.lower_layers import LowerLayers
from trainer.views.setup import TrainingSetup
from trainer.views.view import BACKGROUND, render_view

from .finish import RunResult, write_result
from .paint import (
    RING,
    TRIAL_ANGLES_DEG,
    choose_discs,
    make_goal,
    mean_square_error,
    paint_gdf,
    recolor_gdf,
    recolor_paint,
    views_around_paint,
)
from .resume import picture_digests

TURNS = (-45, -30, -15, 0, 15, 30, 45)
"""Angles of the measured views around the paint, degrees."""


def paste_decal(options: TrainOptions, setup: TrainingSetup, folder: RunFolder, log: RunLog) -> RunResult:
    """Paste paint onto the region, measure it, and write the files of a run, except for a trajectory.

    Args:
        options: resolved options
        setup: scene and region; the editor brings its own view
        folder: folder of the run
        log: log of the run
    """
    scene = setup.scene
    with log.stage("edit"):
        given = make_editor(options.editor, scene, setup.region, (), seen=setup.seen)
        editor = cast(PastingEditor, given)
    view = editor.view
    with log.stage("fit"):
        painted = train_decal(editor, scene, options.name, log, setup.lower)
    names = ",".join(path.name for path in editor_row(options.editor).files(options.editor.text))
    instruction = f"{options.editor.family}:{names}"
    figures = painted.figures
    log.say(painted.choice)
    name = view.camera.name
    view_psnr = figures["own"]
    side_psnrs = figures["turned"]
    about = {"edit": {"psnr_to_views": view_psnr}, "paint": figures}
    save_cameras(folder.cameras, [view.camera], scene.origin)
    front_index = TURNS.index(0)
    mask = view.mask[..., None].expand(-1, -1, 3)
    pictures = {"original": view.image, "mask": mask, "edited": painted.expected[front_index]}
    for folder_name, picture in (pictures | {"final": painted.shown[front_index]}).items():
        write_views(folder, folder_name, {name: picture})
    labels = [f"{degrees:+d}°" if degrees else "0°" for degrees in TURNS]
    title = f"{options.name}: {options.editor.editor}"
    notes = [[], [f"{error} dB" if error is not None else "" for error in side_psnrs.values()]]
    report = {
        **about,
        "views": {"held_out": False, "edit": [name]},
        "time": log.rounded_seconds(),
        "memory_mb": log.peak_mb(),
        "plan": to_json(recorded_options(options)),
        "pictures": picture_digests(options),
    }
    rows = [painted.expected, painted.shown]
    sheet = contact_sheet(rows, ["projected", "the edit"], labels, title, notes=notes)
    result = write_result(folder, replace(painted.gdf, instruction=instruction, report=about), report, sheet)
    added, pixels, moved = (group_digits(figures[name]) for name in ("added", "pixels", "moved"))
    made = f"{added} Gaussians added for {pixels} painted pixels, {moved} of the scene moved behind them"
    if painted.gdf.added is None:
        made = f"{moved} Gaussians recolored for {pixels} painted pixels"
    log.say(
        f"{made}; {view_psnr} dB in its own view, {figures['ring']} dB in the {RING} pixels around it, "
        f"{side_psnrs['-30']} and {side_psnrs['+30']} dB from 30° to either side"
    )
    if figures["left_out"]:
        log.say(
            f"{group_digits(figures['left_out'])} pixels of the picture show no surface of the region and "
            "stay unpainted"
        )
    log.say(result.line)
    return result


@dataclass(frozen=True)
class Painted:
    """Edit that adds discs, and its measured quality."""

    gdf: Gdf
    choice: str  # line that says how the paint was made
    figures: dict[str, Any]  # for report.json
    expected: list[Tensor]  # expected images of the views of `TURNS`. [H,W,3] each
    shown: list[Tensor]  # renders of the edit in these views. [H,W,3] each


def train_decal(
    editor: PastingEditor,
    scene: Gaussians,
    name: str,
    log: RunLog | None = None,
    lower: LowerLayers | None = None,
) -> Painted:
    """Return the edit of a decal or of paint, measured in its first view and from the sides.

    Args:
        editor: see `PastingEditor`
        scene: the original, or `LowerLayers.base`
        name: name of the layer
        log: log of the run
        lower: layers that the painted pictures show; None if they show the original
    """
    paints = editor.paints
    seen = scene if lower is None else lower.seen
    goal = make_goal(scene, paints, seen if len(seen) > len(scene) else None)
    laid = choose_discs(goal, log)
    gdf, edited = _above(lower, scene, paint_gdf(laid, scene, paints, name, None))
    choice = "the paint is made of discs"
    if editor.finds_colors:
        expected = goal.views
        if lower is not None:
            expected = views_around_paint(seen, paints, TRIAL_ANGLES_DEG, shows_pictures=False)
        recolored, recolored_scene = _above(lower, scene, recolor_gdf(recolor_paint(goal), scene, name))
        colors_error = mean_square_error(recolored_scene, expected)
        discs_error = mean_square_error(edited, expected)
        better = "colors of the scene's Gaussians" if colors_error <= discs_error else "discs"
        if colors_error <= discs_error:
            gdf = recolored
            edited = recolored_scene
        choice = (
            f"the paint is made of {better}: {decibels(colors_error):.1f} dB by colors, "
            f"{decibels(discs_error):.1f} dB by discs, in the painted views and from the sides"
        )
    background = torch.tensor(BACKGROUND)
    views = views_around_paint(seen, paints, TURNS, paints[:1], shows_pictures=lower is None)
    images = [render_view(edited, look.camera, background).clamp(0.0, 1.0) for look in views]
    errors = [
        round(psnr(image, look.expected, look.covered), 2) if bool(look.covered.any()) else None
        for image, look in zip(images, views, strict=True)
    ]
    middle = TURNS.index(0)
    figures: dict[str, Any] = {
        "pixels": sum(int(paint.mask.sum()) for paint in paints),
        "left_out": editor.left_out,
        "added": 0 if gdf.added is None else len(gdf.added),
        "moved": len(gdf.region),
        "own": errors[middle],
        "ring": round(psnr(images[middle], views[middle].expected, views[middle].around), 2),
        "turned": {f"{degrees:+d}": error for degrees, error in zip(TURNS, errors, strict=True)},
    }
    asides = [error for degrees, error in zip(TURNS, errors, strict=True) if abs(degrees) == 30 and error]
    if asides:
        figures["summary"] = (
            f"It matches the picture to {errors[middle]:.0f} dB from the front and to {min(asides):.0f} dB "
            "from 30° to the side"
        )
    return Painted(gdf, choice, figures, [look.expected for look in views], images)


def _above(lower: LowerLayers | None, scene: Gaussians, gdf: Gdf) -> tuple[Gdf, Gaussians]:
    """Return an edit of `LowerLayers.base` as an edit of the original, and the scene with all layers."""
    if lower is None:
        return gdf, edited_scene(scene, gdf)
    gdf = lower.rebase(gdf)
    return gdf, lower.compose(gdf)
