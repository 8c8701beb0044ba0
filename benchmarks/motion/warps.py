"""The benchmark `warps`: edits that rigid motions of parts cannot explain, with and without control points.

Their truth is known, so its pictures are the training targets and, in other views, the reference.

    python -m benchmarks warps
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.demo_scenes import bear
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply
from progdf.gaussians import Gaussians
from progdf.rasterize import render
from progdf.region import Region, from_mask
from progdf.scene.bounds import scene_sphere
from trainer.editors import make_editor
from trainer.evaluate.suite.analytic_edits import AnalyticEdit
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.optimize.groups import GROUP_STEPS, Groups, group_stage
from trainer.optimize.losses import Objective, perceptual_loss
from trainer.optimize.pgs import TargetStage, learning_rates, optimize, pgs_settings
from trainer.options import EditorOptions, OptimizeOptions, RegionOptions, TrainingViewOptions, TrainOptions
from trainer.resolve import resolve, resolve_kind
from trainer.run.kinds import Approach, approaches, try_approaches
from trainer.store.run_folder import quantize_image
from trainer.views.boxes import probe_views, widen_views
from trainer.views.crops import CropScene, crop_scene
from trainer.views.setup import TrainingSetup, make_training_setup
from trainer.views.view import View, crop

from ..analytic_warps import column_warps, smile_warp
from ..table import Table

STEPS = 240
VIEWS = 15
SIZE = 160  # pixels
_BEAR_GAUSSIANS = 6000
_STYLE = "style:14"
_ROBOT_LABELS = 1, 2, 3  # the robot and its hands

Picture = Callable[[View], Tensor]


@dataclass(frozen=True)
class WarpCase:
    """One edit of one region."""

    name: str  # names of edit and region
    setup: TrainingSetup  # scene, region, views
    picture: Picture  # renders the finished edit in a view


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure the bear's edits and those of robots whose parts are in NAME_labels.npy beside NAME.ply.

    Raises:
        ProgdfError: a scene has no labels file.
    """
    options = resolve(
        TrainOptions(
            Path("bear.ply"),
            Path("run"),
            RegionOptions("all"),
            EditorOptions("folder:edited"),
            views=TrainingViewOptions(views=VIEWS, image_size=SIZE),
            optimize=OptimizeOptions(STEPS),
        )
    )
    rows = [
        _row(options, case)
        for case in [*_bear_cases(options), *(c for path in scenes for c in _robot_cases(options, path))]
    ]
    return [
        Table(
            "warps",
            "Edits outside the model's own family",
            (
                "edit",
                "members",
                "unedited",
                "free",
                "parts, free",
                "bent",
                "bent, free",
                "trial takes",
                "seconds",
            ),
            tuple(rows),
            f"PSNR in held-out views over the evaluated pixels, dB; {STEPS} steps towards the full edit, "
            f"{VIEWS} views of {SIZE} pixels, a fifth of them held out. free: members only; parts, free: "
            "rigid motions of connected parts first; bent: by control points or nodes, before and after the "
            "members' own steps; seconds: processor time, free, then bent and free.",
        )
    ]


def _row(options: TrainOptions, case: WarpCase) -> tuple[str, ...]:
    setup = case.setup
    edited = [case.picture(view) for view in setup.train]
    judge = make_evaluator(
        setup.scene,
        setup.region,
        setup.held_out,
        {1.0: [case.picture(view) for view in setup.held_out]},
        setup.background,
        14 + 3 * setup.scene.shN.shape[1],
    )
    trial = try_approaches(options, setup, edited, approaches(options, setup, edited))
    setup = widen_views(setup, {1.0: edited})
    original = judge.original
    nothing = torch.zeros_like(original)
    crops = [
        crop_scene(setup.scene, setup.region.members, v.camera, v.box, setup.background) for v in setup.train
    ]
    targets = [crop(p, v.box) for p, v in zip(edited, setup.train, strict=True)]

    def trained(approach: Approach, groups: Groups | None) -> tuple[str, float]:
        begun = time.process_time()
        end = _train(options, setup, crops, targets, original, approach, groups)
        return _psnr(judge, end), time.process_time() - begun

    unedited = _psnr(judge, nothing)
    if trial.chosen.kind != "geometry":
        found, seconds = trained(trial.chosen, None)
        return case.name, str(len(original)), unedited, found, "", "", "", str(trial.chosen), f"{seconds:.0f}"
    free, free_seconds = trained(Approach("geometry"), None)
    grouped = Approach("geometry", GROUP_STEPS)
    begun = time.process_time()
    groups = group_stage(original, crops, [targets], GROUP_STEPS)
    searched = time.process_time() - begun
    parts, _ = trained(grouped, replace(groups, warps=(), nodes=()))
    if not groups.warps and not groups.nodes:
        seconds_text = f"{free_seconds:.0f}"
        return case.name, str(len(original)), unedited, free, parts, "", "", str(trial.chosen), seconds_text
    bent = _psnr(judge, groups.placements[0].carry(original, nothing))
    both, both_seconds = trained(grouped, groups)
    seconds_text = f"{free_seconds:.0f}, {searched + both_seconds:.0f}"
    return case.name, str(len(original)), unedited, free, parts, bent, both, str(trial.chosen), seconds_text


def _train(
    options: TrainOptions,
    setup: TrainingSetup,
    crops: Sequence[CropScene],
    targets: Sequence[Tensor],
    original: Tensor,
    approach: Approach,
    groups: Groups | None,
) -> Tensor:
    """Train the members and return their final offsets. [M,C]"""
    optimization = resolve_kind(options, approach.kind, approach.group_steps)
    stages = [TargetStage(1.0, targets, STEPS)]
    extent = 2.0 * scene_sphere(setup.scene[setup.region.members])[1]
    if groups is not None:
        stages = groups.to_stages(original, crops, stages)
        extent = groups.extent
    rates = learning_rates(approach.kind, original.shape[1], extent)
    settings = pgs_settings(optimization, rates, 1)
    objective = Objective(perceptual_loss()[0], optimization)
    *_, last = optimize(original, crops, probe_views(setup), stages, objective, settings)
    return last.offsets


def _psnr(judge: Evaluator, offsets: Tensor) -> str:
    return f"{judge.psnr(judge.pictures(offsets), judge.edited[1.0]):.1f}"


def _bear_cases(options: TrainOptions) -> list[WarpCase]:
    demo = bear(_BEAR_GAUSSIANS)
    scene = demo.gaussians
    head = demo.members("head")
    body = demo.members("body")
    corners = torch.tensor([[0.11, 1.305, 0.56], [-0.11, 1.305, 0.56]])
    columns = column_warps(scene.means[body], demo.up)
    found = [_case(options, f"bear's body: {name}", scene, body, edit) for name, edit in columns.items()]
    found.append(_case(options, "bear: smile", scene, head, smile_warp(corners, demo.up, 0.08, 0.07)))
    setup = _setup(options, scene, body)
    try:
        editor = make_editor(EditorOptions(_STYLE), scene, setup.region, setup.views)
    except ProgdfError:  # its weights need an optional package
        return found
    return [*found, WarpCase(f"bear's body: {_STYLE}", setup, lambda v: quantize_image(editor.edit(v, 1.0)))]


def _robot_cases(options: TrainOptions, path: Path) -> list[WarpCase]:
    labels = path.with_name(f"{path.stem}_labels.npy")
    if not labels.is_file():
        raise ProgdfError(f"{labels} does not exist; put the labels of the robot beside {path.name}")
    scene = load_ply(path)
    members = torch.from_numpy(np.isin(np.load(labels), _ROBOT_LABELS)).nonzero()[:, 0]
    columns = column_warps(scene.means[members], torch.tensor([0.0, -1.0, 0.0]))
    return [_case(options, f"{path.stem}: {name}", scene, members, edit) for name, edit in columns.items()]


def _case(
    options: TrainOptions, name: str, scene: Gaussians, members: Tensor, edit: AnalyticEdit
) -> WarpCase:
    setup = _setup(options, scene, members)
    edited = edit.apply(scene, members, 1.0)

    def picture(view: View) -> Tensor:
        with torch.no_grad():
            return quantize_image(render(edited, view.camera, setup.background).image.clamp(0.0, 1.0))

    return WarpCase(name, setup, picture)


def _setup(options: TrainOptions, scene: Gaussians, members: Tensor) -> TrainingSetup:
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[members] = True
    region: Region = from_mask("region", mask)
    return make_training_setup(options.views, scene, region)
