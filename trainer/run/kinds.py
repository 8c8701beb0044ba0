"""Trial runs that choose which attributes to train for pictures that another program edited.

A picture does not tell whether its edit recolors, paints, bends or moves. The wrong choice tears parts that
should bend, or freezes parts that should be painted. Therefore all kinds are tried for a few steps, on views
of 128 pixels with L1 only, and evaluated on held-out views (docs/lab/experiments.md, The trial that finds the
kind of an edit).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from progdf.gaussians import pack
from progdf.metrics.image import ROUNDING
from progdf.scene.bounds import scene_sphere
from trainer.editors import editor_row
from trainer.editors.base import ImageEditor, confines_edit
from trainer.fit.evaluate import Evaluator
from trainer.methods import METHODS
from trainer.optimize.groups import GROUP_STEPS, group_stage
from trainer.optimize.growth import place_seeds, seed_rows
from trainer.optimize.losses import GradientL1, Objective
from trainer.optimize.pgs import TargetStage, optimize, pgs_settings
from trainer.options import EditKind, OptimizeOptions, TrainOptions, with_values
from trainer.resolve import resolve_kind
from trainer.store.progress import Advance, RunLog
from trainer.views.boxes import shrink_view
from trainer.views.crops import CropScene
from trainer.views.setup import TrainingSetup
from trainer.views.view import View, fit_size

_SMALL_SIDE_PX = 128  # longer side of the small views
_MAX_VIEWS = 12  # views with the largest change; every third one is held out
_MAX_STEPS = 60  # per trial
_MIN_STEPS = 24  # per trial
_STEP_SHARE = 1 / 6  # steps of a trial per step of the run
_COLOR_ALLOWANCE_DB = 0.2  # colors alone may be worse by this than all attributes, as they take fewer bytes
_MIN_GEOMETRY_GAIN = 0.8
"""Minimum gain of moving, as a share of the gain of painting in dB, to choose moving.

A moved part that is painted instead looks torn at a similar PSNR. Moving has 0.2 to 0.4 of the gain of
painting on painted edits, and 0.85 to 1.2 of it on a pulled mouth.
"""
_MIN_GROWTH_GAIN = 0.1  # share of the error that growth must remove
# share of changed pixels outside the region above which the whole picture counts as repainted
_REPAINTED_SHARE = 0.3


@dataclass(frozen=True)
class Approach:
    """Training variant: the attributes that move, and how."""

    kind: EditKind  # attributes that move
    group_steps: int = 0  # steps of the stage in which connected parts move rigidly; 0 omits it
    grow: float = 0.0  # see `OptimizeOptions.grow`

    def __str__(self) -> str:
        grows = " with growth" if self.grow else ""
        return f"{self.kind} in parts" if self.group_steps else self.kind + grows

    @property
    def said(self) -> str:
        """Command-line options that select this approach."""
        moved = f" --group-steps {self.group_steps}" if self.kind == "geometry" else ""
        return f"--kind {self.kind}{moved}"


@dataclass(frozen=True)
class Trial:
    """Result of a trial run."""

    steps: int  # per approach
    psnrs: Mapping[Approach, float]  # PSNR of each approach in the held-out views, dB
    unedited: float  # PSNR of the original in these views, dB

    @property
    def chosen(self) -> Approach:
        """The best approach within the allowances of `_MIN_GEOMETRY_GAIN` and `_COLOR_ALLOWANCE_DB`."""
        best_growing = max(
            (approach for approach in self.psnrs if approach.grow), key=self._gain, default=None
        )
        plain = self._plain
        prefers_geometry = plain.kind == "geometry" and self._gain(plain) > max(
            0.0, _MIN_GEOMETRY_GAIN * self._gain(best_growing or plain)
        )
        if best_growing is None or prefers_geometry:
            return plain
        error, grown_error = (
            ROUNDING + 10 ** (-self.psnrs[approach] / 10) for approach in (plain, best_growing)
        )
        return best_growing if grown_error < (1 - _MIN_GROWTH_GAIN) * error else plain

    @property
    def _plain(self) -> Approach:
        """The best approach without growth."""
        moving = [approach for approach in self.psnrs if approach.kind == "geometry" and not approach.grow]
        painting = [approach for approach in self.psnrs if approach.kind != "geometry" and not approach.grow]
        best_moving = max(moving, key=self._gain, default=None)
        best_painting = max(painting, key=self._gain, default=None)
        if best_moving is not None and (
            best_painting is None
            or self._gain(best_moving) > max(0.0, _MIN_GEOMETRY_GAIN * self._gain(best_painting))
        ):
            return best_moving
        assert best_painting is not None
        return next(
            approach
            for approach in painting
            if self._gain(approach) >= self._gain(best_painting) - _COLOR_ALLOWANCE_DB
        )

    def _gain(self, way: Approach) -> float:
        return self.psnrs[way] - self.unedited

    def line(self) -> str:
        """Return the log line."""
        tried = ", ".join(f"{approach} {psnr:.1f}" for approach, psnr in self.psnrs.items())
        note = "" if self.chosen.grow else f" ({self.chosen.said} skips the trial)"
        if not self.chosen.grow and any(candidate.grow for candidate in self.psnrs):
            note = ": growth removes less than 10 % of the error, or replaces parts that move"
        return (
            f"trial run of {self.steps} steps with L1 on small views, PSNR in held-out views: unedited "
            f"{self.unedited:.1f}, {tried} dB; chosen: {self.chosen}{note}"
        )

    def figures(self) -> dict[str, Any]:
        """Return the figures for report.json.

        Growth is included only if chosen, so that a run without growth writes the same report.
        """
        reported = [approach for approach in self.psnrs if not approach.grow or approach == self.chosen]
        return {
            "steps": self.steps,
            "loss": "L1",
            "unedited_psnr": round(self.unedited, 2),
            "psnr": {
                str(approach): round(psnr, 2) for approach, psnr in self.psnrs.items() if approach in reported
            },
            "chosen": str(self.chosen),
        }


def choose_approach(
    options: TrainOptions, setup: TrainingSetup, editor: ImageEditor, log: RunLog
) -> tuple[Approach, dict[str, Any] | None]:
    """Return the approach set by plan and editor, or found by a trial run, and the trial's figures.

    A method that moves all attributes in any case needs no trial: geometry does not confine the edit.

    Args:
        options: resolved options
        setup: the training views
        editor: makes the finished edit of each view
        log: log of the run

    Raises:
        ProgdfError: an edited view is missing or broken.
    """
    optimize = options.optimize
    knows_kind = editor_row(options.editor).knows_kind
    kind = editor.kind if optimize.kind == "auto" and knows_kind else optimize.kind
    if kind == "color" or (kind == "style" and not optimize.grow):
        return Approach(kind), None
    if kind == "geometry" and optimize.group_steps is not None and not optimize.grow:
        return Approach(kind, optimize.group_steps), None
    edited = [editor.edit(view, 1.0) for view in setup.train]
    candidates = approaches(with_values(options, kind=kind), setup, edited)
    if candidates[-1] == Approach("style", grow=optimize.grow) and confines_edit(editor, "style"):
        edited = [view.confine(picture) for view, picture in zip(setup.train, edited, strict=True)]
    if all(torch.equal(picture, view.image) for picture, view in zip(edited, setup.train, strict=True)):
        return candidates[0], None
    if not METHODS[options.preset].kinds_differ and not optimize.grow:
        moving = [candidate for candidate in candidates if candidate.kind == "geometry"]
        return (moving or candidates)[0], None
    with log.steps("try kinds", len(candidates)) as advance:
        trial = try_approaches(options, setup, edited, candidates, advance)
    log.say(trial.line())
    is_open = len(candidates) > 2 or trial.chosen.grow or not optimize.grow
    return trial.chosen, trial.figures() if is_open else None


def approaches(options: TrainOptions, setup: TrainingSetup, edited: Sequence[Tensor]) -> list[Approach]:
    """Return the approaches that the plan leaves open, those that change least first.

    If a tool repaints the whole picture, motion cannot be distinguished from new paint outside the region,
    and moving the region over it is not an edit of the region. Geometry is then tried only on request.

    Args:
        options: resolved options
        setup: the training views
        edited: the full edit of each view, not confined to the region. [H,W,3]
    """
    optimize = options.optimize
    groups = GROUP_STEPS if optimize.group_steps is None else optimize.group_steps
    geometry = []
    if not groups or optimize.group_steps is None:
        geometry.append(Approach("geometry"))
    if groups:
        geometry.append(Approach("geometry", groups))
    grow = []
    if optimize.grow:
        grow.append(Approach("geometry", grow=optimize.grow))
    if optimize.kind == "geometry":
        return geometry + grow
    grow = [replace(approach, kind="style") for approach in grow]
    if optimize.kind != "auto":
        return [Approach(optimize.kind), *grow]
    changed = beside = 0.0
    for view, picture in zip(setup.train, edited, strict=True):
        outside = view.mask < 0.05
        changed += float(((picture - view.image).abs().amax(dim=2) > 0.05)[outside].sum())
        beside += float(outside.sum())
    if changed > _REPAINTED_SHARE * beside:
        return [Approach("color"), Approach("style"), *grow]
    return [
        Approach("color"),
        Approach("style"),
        *geometry,
        *(replace(approach, kind="geometry") for approach in grow),
    ]


def try_approaches(
    options: TrainOptions,
    setup: TrainingSetup,
    edited: Sequence[Tensor],
    ways: Sequence[Approach],
    advance: Advance | None = None,
) -> Trial:
    """Try some approaches. The same inputs give the same figures.

    Args:
        options: options of the run
        setup: scene, region and training views
        edited: the full edit of each training view, not confined to the region. [H,W,3]
        ways: see `approaches`
        advance: reports the number of approaches tried

    Raises:
        FloatingPointError: a loss is not finite.
    """
    changed = sorted(zip(setup.train, edited, strict=True), key=lambda pair: -_change(*pair))[:_MAX_VIEWS]
    trained = [pair for i, pair in enumerate(changed) if i % 3 != 1]
    plain = _small_views(setup, changed)
    unedited = _psnr(plain, torch.zeros_like(plain.original))
    steps = max(_MIN_STEPS, min(_MAX_STEPS, round(_STEP_SHARE * options.optimize.steps)))
    psnrs: dict[Approach, float] = {}
    for approach in ways:
        extended = setup
        small = plain
        seeds = 0
        if approach.grow:
            views, pictures = zip(*trained, strict=True)
            rows = seed_rows(
                setup, views, pictures, int(approach.grow * len(setup.region)), options.optimize.seed
            )
            extended = setup.extend(rows)
            seeds = len(rows)
            small = _small_views(extended, changed)
        psnrs[approach] = _try_approach(options, approach, extended, seeds, small, steps)
        if advance is not None:
            advance(len(psnrs), f"{approach} {psnrs[approach]:.1f} dB")
    return Trial(steps, psnrs, unedited)


def _try_approach(
    options: TrainOptions,
    way: Approach,
    setup: TrainingSetup,
    seeds: int,
    small: Evaluator,
    steps: int,
) -> float:
    """Train an approach for some steps; return its PSNR in the held-out views, dB.

    `seeds`: number of added members, which come last
    """
    training = small.only([i for i in range(len(small.crops)) if i % 3 != 1])
    original = small.original
    crops = training.crops
    targets = training.edited[1.0]
    stage = TargetStage(1.0, targets, steps)
    if way.group_steps:
        # only the rigid motion of parts; optimizing single members takes longer than a trial
        groups = group_stage(original, crops, [targets], steps, options.optimize.seed)
        end = groups.to_stages(original, crops, [stage])[0].place(torch.zeros_like(original))
    else:
        resolved = resolve_kind(with_values(options, steps=steps), way.kind, 0)
        extent = 2.0 * scene_sphere(setup.scene[setup.region.members])[1]
        rates = METHODS[options.preset].learning_rates(way.kind, original.shape[1], extent)
        settings = replace(pgs_settings(resolved, rates, 1), snapshots=1)
        if seeds:
            stage = place_seeds(stage, seeds)
            settings = replace(settings, ramp=0.0)
        objective = Objective(GradientL1(), OptimizeOptions(perceptual_weight=0.0))
        *_, last = optimize(original, crops, [], [stage], objective, settings)
        end = last.offsets
    return _psnr(small, end)


def resolve_approach(options: TrainOptions, way: Approach) -> OptimizeOptions:
    """Return the optimization options of an approach, see `resolve_kind`."""
    return resolve_kind(options, way.kind, way.group_steps, way.grow)


def _small_views(setup: TrainingSetup, pairs: Sequence[tuple[View, Tensor]]) -> Evaluator:
    """Return an evaluator of the views and their edited pictures at small size."""
    small = [_small_view(setup, view.widen([picture]), picture) for view, picture in pairs]
    crops, targets, pixels = zip(*small, strict=True)
    original = pack(setup.scene[setup.region.members], with_shN=setup.scene.sh_degree > 0)
    return Evaluator(original, crops, pixels, {1.0: targets}, [view.camera.name for view, _ in pairs])


def _small_view(setup: TrainingSetup, view: View, picture: Tensor) -> tuple[CropScene, Tensor, Tensor]:
    """Return the small scene to render, its target picture, and the mask of the counted pixels.

    A shrunk picture differs from a small render, also where nothing is edited. The target is therefore the
    small render of the original with the shrunk change.
    """
    camera = fit_size(view.camera, _SMALL_SIDE_PX)
    scene, shrink, counting = shrink_view(setup, view, picture, camera)
    target = shrink(picture)
    if camera.width < view.camera.width:
        with torch.no_grad():
            unedited = scene.render(
                pack(setup.scene[setup.region.members], with_shN=setup.scene.sh_degree > 0)
            )
        target = (unedited + target - shrink(view.image)).clamp(0.0, 1.0)
    return scene, target, counting[..., 0] > 0.5


def _psnr(small: Evaluator, offsets: Tensor) -> float:
    """Return the PSNR in the held-out views, or in the only view, dB."""
    count = len(small.crops)
    held_out = small.only(range(1, count, 3) or range(count))
    return held_out.psnr(held_out.pictures(offsets), held_out.edited[1.0])


def _change(view: View, picture: Tensor) -> float:
    return float((picture - view.image).abs().mean())
