"""The whole job: scene → views → edited views → trajectory → field → .gdf and report, each on disk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.camera_files import load_cameras, save_cameras
from progdf.errors import ProgdfError
from progdf.framing import scene_sphere
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from progdf.ply import load_ply
from progdf.rasterize import render, set_threads
from progdf.region import Region
from progdf.region_spec import parse_region
from trainer.artefacts import RunFolder, claim, remove_stale_views, signature, write_views
from trainer.crops import crop_scene, moving_attributes, render_all
from trainer.editors import check_editor, make_editor
from trainer.editors.base import EditKind
from trainer.finish import RunResult, end_rows, finished, kept_judge
from trainer.fit import without_idle_attributes
from trainer.losses import Perceptual, eroded, perceptual_loss
from trainer.objective import Losses, Objective, loss_table
from trainer.options import FitOptions, TrainOptions, settled
from trainer.pgs import Stage, optimise
from trainer.preparation import (
    BACKGROUND,
    Pictures,
    Stand,
    edited_views,
    editor_settings,
    eight_bits,
    make_stand,
    probes,
    strengths_to_ask,
    to_confine,
    widened,
)
from trainer.progress import RunLog
from trainer.settings import loss_weights, pgs_settings
from trainer.trajectory import Trajectory, load_trajectory, record, retime, save_trajectory, straightened
from trainer.views import crop, make_view

__all__ = ["RunResult", "refit", "train", "use_threads"]


def train(options: TrainOptions, quiet: bool = False) -> RunResult:
    """Edit a region of a scene and write its .gdf file.

    Args:
        options: see TrainOptions
        quiet: nothing on the screen; log.txt is written all the same

    Raises:
        ProgdfError: options, scene, region, cameras or edited views that do not work; no .gdf is touched.
        KeyboardInterrupt: interrupted; the message says what is left. No .gdf is touched.
    """
    options = settled(options)
    check_editor(options.editor)
    use_threads(options.threads)
    scene = load_ply(options.scene)
    region = parse_region(options.region, scene, options.name)
    edit = {"scene": str(options.scene.resolve()), "region": options.region, "editor": options.editor}
    folder = claim(options.out, edit)
    log = RunLog(folder.log, quiet)
    log.head(signature(edit))
    try:
        return _trained(options, scene, region, folder, log)
    except KeyboardInterrupt:
        log.say("interrupted")
        raise KeyboardInterrupt(f"no edit was written to {folder.root}; run the command again") from None
    finally:
        log.close()


def _trained(
    options: TrainOptions, scene: Gaussians, region: Region, folder: RunFolder, log: RunLog
) -> RunResult:
    perceptual, warning = perceptual_loss(options.perceptual)
    if warning:
        log.say(warning)
    with log.stage("views"):
        stand = make_stand(options, scene, region)
        views = [*stand.train, *stand.held_out]
        names = [view.camera.name for view in views]
        remove_stale_views(folder, names)
        write_views(folder, "original", {view.camera.name: view.image for view in views})
        write_views(
            folder, "mask", {view.camera.name: view.mask[..., None].expand(-1, -1, 3) for view in views}
        )
        save_cameras(folder.cameras, [view.camera for view in views])
    log.say(
        f"{len(scene)} Gaussians, {len(region)} in the region; {len(stand.train)} views to train on and "
        f"{len(stand.held_out)} to measure with, {views[0].camera.width}x{views[0].camera.height} pixels"
    )
    with log.stage("edit"):
        editor = make_editor(options.editor, scene, region, views, editor_settings(options, folder))
        strengths = strengths_to_ask(editor, options.stages)
        kind: EditKind = editor.kind if options.kind == "auto" else options.kind
        confined = to_confine(editor, options, kind)
        with log.steps("edit", len(views) * len(strengths)) as advance:
            edited = edited_views(editor, views, strengths, folder, confined, advance)
        train_edits = {s: pictures[: len(stand.train)] for s, pictures in edited.items()}
        stand = widened(stand, train_edits)
    if all(
        torch.equal(p, eight_bits(v.image)) for s in edited for p, v in zip(edited[s], views, strict=True)
    ):
        raise ProgdfError(
            f"{options.editor} changes none of the views; check the region and what the editor is asked for"
        )
    log.say(f"{options.editor}: a {kind} edit at strength {', '.join(f'{s:g}' for s in strengths)}")

    objective = loss_weights(options, kind).described(perceptual.name)
    log.say(f"loss: {objective}")
    with log.stage("optimise"):
        trajectory, losses = _optimised(options, stand, train_edits, kind, perceptual, log)
    with log.stage("retime"):
        channels = trajectory.end.shape[1]
        judge = kept_judge(folder, stand, stand.held_out, trajectory.strengths, channels)
        trajectory, costs = without_idle_attributes(trajectory, judge)
        recorded = len(trajectory)
        trajectory = _retimed(trajectory, stand, options)
    log.say(
        f"{recorded} recordings, {len(trajectory)} kept; without an attribute, dB: {costs or 'none moves'}"
    )
    about = {
        "scene": str(options.scene.resolve()),
        "held_out": [view.camera.name for view in stand.held_out],
        "background": list(BACKGROUND),
        "options": plain_options(options),
        "objective": objective,
        "losses": losses,
        "attribute_worth_db": costs,
    }
    extra = {"members": region.members, "score": region.score}
    save_trajectory(folder.trajectory, trajectory, extra, about)
    with log.stage("final"):
        edited_scene = scene.replace_rows(region.members, end_rows(stand, trajectory))
        with torch.no_grad():
            finals = {v.camera.name: render(edited_scene, v.camera, stand.background) for v in views}
        write_views(folder, "final", finals)
    measure = perceptual if options.perceptual == "alex" else perceptual_loss()[0]
    return finished(folder, stand, trajectory, about, measure, log, options.field)


def refit(options: FitOptions, quiet: bool = False) -> RunResult:
    """Fit the field of a finished run anew and rewrite its .gdf and report; nothing is optimised.

    Raises:
        ProgdfError: the folder is no finished run, or its scene is gone or another.
    """
    use_threads(options.threads)
    folder = RunFolder(options.run)
    if not folder.trajectory.is_file():
        raise ProgdfError(
            f"{options.run} holds no trajectory.safetensors; give a folder that progdf train finished"
        )
    trajectory, extra, about = load_trajectory(folder.trajectory)
    path = options.scene or Path(about["scene"])
    if not path.is_file():
        raise ProgdfError(f"the scene {path} is gone; tell where it is with --scene")
    scene = load_ply(path)
    score = extra["score"]
    if len(score) != len(scene):
        raise ProgdfError(
            f"{path} has {len(scene)} Gaussians, the run's scene had {len(score)}; give that one with --scene"
        )
    trained = about["options"]
    region = Region(trained["name"], extra["members"], score)
    background = torch.tensor(about["background"])
    log = RunLog(folder.log, quiet, append=True)
    try:
        with log.stage("views"):
            held_out = set(about["held_out"])
            views = [make_view(scene, region, camera, background) for camera in load_cameras(folder.cameras)]
            stand = Stand(
                scene,
                region,
                [view for view in views if view.camera.name not in held_out],
                [view for view in views if view.camera.name in held_out],
                background,
            )
        perceptual, warning = perceptual_loss()
        if warning:
            log.say(warning)
        about = {**about, "options": {**trained, "field": options.field, "target_psnr": options.target_psnr}}
        return finished(folder, stand, trajectory, about, perceptual, log, options.field)
    finally:
        log.close()


def use_threads(wanted: int) -> None:
    """Give torch and the rasteriser `wanted` threads; 0 is all cores but one, at least one."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = wanted or max(1, cores - 1)
    torch.set_num_threads(count)
    set_threads(count)


def plain_options(options: TrainOptions) -> dict[str, Any]:
    """The options as JSON values."""
    return {name: str(v) if isinstance(v, Path) else v for name, v in asdict(options).items()}


def _optimised(
    options: TrainOptions,
    stand: Stand,
    edited: Pictures,
    kind: EditKind,
    perceptual: Perceptual,
    log: RunLog,
) -> tuple[Trajectory, Losses]:
    """PGS over the training views.

    Returns:
        The trajectory, even in time; mean of every loss term, and what is left to the edit, per recording
    """
    scene, members = stand.scene, stand.region.members
    original = pack(scene[members], with_shN=scene.sh_degree > 0)
    crops = [crop_scene(scene, members, v.camera, v.box, stand.background) for v in stand.train]
    stages = [
        Stage(s, [crop(p, v.box) for p, v in zip(pictures, stand.train, strict=True)], steps)
        for (s, pictures), steps in zip(edited.items(), _shared(options.steps, len(edited)), strict=True)
    ]
    extent = 2.0 * scene_sphere(scene[members])[1]
    settings = pgs_settings(options, kind, original.shape[1], extent, len(stages))
    weights = loss_weights(options, kind)
    inside = [eroded(crop(view.mask, view.box)) for view in stand.train]
    snapshots: list[tuple[int, int, bool, Tensor]] = []
    losses: list[tuple[int, Mapping[str, float]]] = []
    with log.steps("optimise", sum(stage.steps for stage in stages)) as advance:
        try:
            for found in optimise(
                original,
                crops,
                probes(stand),
                stages,
                Objective(perceptual, weights, inside),
                settings,
                lambda step, left: advance(step, f"loss to the edit {left:.4f}"),
            ):
                snapshots.append((found.step, found.stage, found.ends_stage, found.offsets.half()))
                losses.append((found.step, found.means))
                end = found.offsets
        except FloatingPointError as error:
            raise ProgdfError(
                f"training broke down: {error}; check the edited views, or try --kind style"
            ) from error
    left = [means["left"] for _, means in losses]
    log.say(f"L1 to the finished edit: {left[0]:.4f} at first, {left[-1]:.4f} at the end")
    return record(snapshots, end, list(edited)), loss_table(losses)


def _retimed(trajectory: Trajectory, stand: Stand, options: TrainOptions) -> Trajectory:
    """Without jitter, and at the slider values where its change is due."""
    small = probes(stand)
    rows = pack(stand.scene[stand.region.members], with_shN=trajectory.end.shape[1] > BASE_CHANNELS)

    moving = moving_attributes(trajectory.end)

    def seen(offsets: Tensor) -> Tensor:
        return torch.cat([picture.flatten() for picture in render_all(small, rows + offsets, moving)])

    if options.recording == "smooth":
        trajectory = straightened(trajectory, seen)
    return retime(trajectory, seen, options.slider)


def _shared(steps: int, stages: int) -> list[int]:
    """Steps per stage, adding up to `steps`; the last, which is looked at most, has twice as many."""
    marks = [steps * i // (stages + 1) for i in range(stages)]
    return [b - a for a, b in pairwise([*marks, steps])]
