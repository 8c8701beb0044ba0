"""How to train towards pictures edited elsewhere: the ways to do it are tried on a few small views.

A picture does not say whether its edit recolors, paints, bends or moves, and the wrong way tears what should
bend and freezes what should be painted. So all are tried for a moment, on views of 128 pixels with L1 alone,
and judged by views that they did not see (docs/experiments.md, The trial that finds the kind of an edit).
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
from trainer.editors import KIND_UNKNOWN
from trainer.editors.base import ImageEditor
from trainer.fit.evaluate import Evaluator
from trainer.optimize.groups import GROUP_STEPS, group_stage
from trainer.optimize.growth import place_seeds, seed_rows
from trainer.optimize.losses import GradientL1, Objective
from trainer.optimize.pgs import TargetStage, optimize, pgs_settings
from trainer.options import EditKind, OptimizeOptions, TrainOptions, with_values
from trainer.resolve import resolve_kind
from trainer.setup import TrainingSetup, confines_edit, shrink_view
from trainer.store.progress import Advance, RunLog
from trainer.views.crops import CropScene
from trainer.views.view import View, fit_size

_SIZE = 128  # longer side of the small views, pixels
_VIEWS = 12  # of those that change most; every third judges
# of a trial; share of the run's own
_MAX_STEPS = 60
_MIN_STEPS = 24
_SHARE = 1 / 6
_AS_GOOD = 0.2  # dB by which training colors alone may be worse than training all: it takes fewer bytes
_MOVED = 0.8
"""Share of the gain of painting, in dB, from which moving is taken: what moved and is painted looks torn at a
PSNR that is no worse. Moving gains .2-.4 of it where paint was meant, .85-1.2 where a mouth was pulled.
"""
_GROWS = 0.1  # of the error, which growth must take away
_REPAINTED = 0.3  # share of the pixels beside the region that change where a tool repaints the whole picture


@dataclass(frozen=True)
class Approach:
    """A way to train."""

    kind: EditKind  # what moves
    group_steps: int = 0  # of the stage in which connected parts move as wholes; 0 leaves it out
    grow: float = 0.0  # see `OptimizeOptions.grow`

    def __str__(self) -> str:
        grows = " with growth" if self.grow else ""
        return f"{self.kind} in parts" if self.group_steps else self.kind + grows

    @property
    def said(self) -> str:
        """The options that ask for it."""
        moved = f" --group-steps {self.group_steps}" if self.kind == "geometry" else ""
        return f"--kind {self.kind}{moved}"


@dataclass(frozen=True)
class Trial:
    """What came of it."""

    steps: int  # of each approach
    psnrs: Mapping[Approach, float]  # of each approach on the judging views, dB
    unedited: float  # the original's, dB

    @property
    def chosen(self) -> Approach:
        """The best, with the allowances of `_MOVED` and `_AS_GOOD`."""
        grown = max((way for way in self.psnrs if way.grow), key=self._gain, default=None)
        plain = self._plain
        moves = plain.kind == "geometry" and self._gain(plain) > max(0.0, _MOVED * self._gain(grown or plain))
        if grown is None or moves:
            return plain
        before, after = (ROUNDING + 10 ** (-self.psnrs[way] / 10) for way in (plain, grown))
        return grown if after < (1 - _GROWS) * before else plain

    @property
    def _plain(self) -> Approach:
        """The best that adds nothing."""
        moving = [way for way in self.psnrs if way.kind == "geometry" and not way.grow]
        painting = [way for way in self.psnrs if way.kind != "geometry" and not way.grow]
        moved = max(moving, key=self._gain, default=None)
        painted = max(painting, key=self._gain, default=None)
        if moved is not None and (
            painted is None or self._gain(moved) > max(0.0, _MOVED * self._gain(painted))
        ):
            return moved
        assert painted is not None
        return next(way for way in painting if self._gain(way) >= self._gain(painted) - _AS_GOOD)

    def _gain(self, way: Approach) -> float:
        return self.psnrs[way] - self.unedited

    def line(self) -> str:
        """For the log."""
        tried = ", ".join(f"{approach} {psnr:.1f}" for approach, psnr in self.psnrs.items())
        skips = "" if self.chosen.grow else f" ({self.chosen.said} skips the trial)"
        if not self.chosen.grow and any(way.grow for way in self.psnrs):
            skips = ": growth would not take a tenth of the error away, or takes the place of what moves"
        return (
            f"tried for {self.steps} steps with L1 on small views, PSNR in other views: unedited "
            f"{self.unedited:.1f}, {tried} dB; taken: {self.chosen}{skips}"
        )

    def figures(self) -> dict[str, Any]:
        """As report.json has it: growth only where it was taken, as a run without it writes the same."""
        reported = [way for way in self.psnrs if not way.grow or way == self.chosen]
        return {
            "steps": self.steps,
            "loss": "L1",
            "unedited_psnr": round(self.unedited, 2),
            "psnr": {str(way): round(psnr, 2) for way, psnr in self.psnrs.items() if way in reported},
            "chosen": str(self.chosen),
        }


def choose_approach(
    options: TrainOptions, setup: TrainingSetup, editor: ImageEditor, log: RunLog
) -> tuple[Approach, dict[str, Any] | None]:
    """What plan and editor say, or a trial finds where they leave it open; and the trial's figures.

    Args:
        options: resolved
        setup: the training views
        editor: pictures the finished edit
        log: of the run

    Raises:
        ProgdfError: an edited view is missing or broken.
    """
    optimize = options.optimize
    knows_kind = options.editor.family not in KIND_UNKNOWN
    kind = editor.kind if optimize.kind == "auto" and knows_kind else optimize.kind
    if kind == "color" or (kind == "style" and not optimize.grow):
        return Approach(kind), None
    if kind == "geometry" and optimize.group_steps is not None and not optimize.grow:
        return Approach(kind, optimize.group_steps), None
    edited = [editor.edit(view, 1.0) for view in setup.train]
    ways = approaches(with_values(options, kind=kind), setup, edited)
    if ways[-1] == Approach("style", grow=optimize.grow) and confines_edit(editor, "style"):
        edited = [view.confine(picture) for view, picture in zip(setup.train, edited, strict=True)]
    if all(torch.equal(picture, view.image) for picture, view in zip(edited, setup.train, strict=True)):
        return ways[0], None
    with log.steps("try kinds", len(ways)) as advance:
        trial = try_approaches(options, setup, edited, ways, advance)
    log.say(trial.line())
    is_open = len(ways) > 2 or trial.chosen.grow or not optimize.grow
    return trial.chosen, trial.figures() if is_open else None


def approaches(options: TrainOptions, setup: TrainingSetup, edited: Sequence[Tensor]) -> list[Approach]:
    """The ways that the plan leaves open, those that move least first.

    Where a tool repaints the whole picture nothing tells what moved from what was painted anew beside it, and
    moving the region over that is no edit of it: geometry is then not tried unless it is asked for.

    Args:
        options: resolved
        setup: the training views
        edited: the full edit of each view, not confined to the region. [H,W,3]
    """
    optimize = options.optimize
    groups = GROUP_STEPS if optimize.group_steps is None else optimize.group_steps
    geometry = [Approach("geometry")] if not groups or optimize.group_steps is None else []
    geometry += [Approach("geometry", groups)] if groups else []
    grow = [Approach("geometry", grow=optimize.grow)] if optimize.grow else []
    if optimize.kind == "geometry":
        return geometry + grow
    grow = [replace(way, kind="style") for way in grow]
    if optimize.kind != "auto":
        return [Approach(optimize.kind), *grow]
    changed = beside = 0.0
    for view, picture in zip(setup.train, edited, strict=True):
        outside = view.mask < 0.05
        changed += float(((picture - view.image).abs().amax(dim=2) > 0.05)[outside].sum())
        beside += float(outside.sum())
    if changed > _REPAINTED * beside:
        return [Approach("color"), Approach("style"), *grow]
    return [Approach("color"), Approach("style"), *geometry, *(replace(way, kind="geometry") for way in grow)]


def try_approaches(
    options: TrainOptions,
    setup: TrainingSetup,
    edited: Sequence[Tensor],
    ways: Sequence[Approach],
    advance: Advance | None = None,
) -> Trial:
    """Try some ways; the same inputs give the same figures.

    Args:
        options: of the run
        setup: scene, region and training views
        edited: the full edit of each training view, not confined to the region. [H,W,3]
        ways: see `approaches`
        advance: progress: ways tried

    Raises:
        FloatingPointError: a loss is not finite.
    """
    most = sorted(zip(setup.train, edited, strict=True), key=lambda pair: -_change(*pair))[:_VIEWS]
    trained = [pair for i, pair in enumerate(most) if i % 3 != 1]
    plain = _small_views(setup, most)
    unedited = _psnr(plain, torch.zeros_like(plain.original))
    steps = max(_MIN_STEPS, min(_MAX_STEPS, round(_SHARE * options.optimize.steps)))
    psnrs: dict[Approach, float] = {}
    for way in ways:
        grown = setup
        small = plain
        seeds = 0
        if way.grow:
            views, pictures = zip(*trained, strict=True)
            rows = seed_rows(setup, views, pictures, int(way.grow * len(setup.region)), options.optimize.seed)
            grown = setup.extend(rows)
            seeds = len(rows)
            small = _small_views(grown, most)
        psnrs[way] = _try_approach(options, way, grown, seeds, small, steps)
        if advance is not None:
            advance(len(psnrs), f"{way} {psnrs[way]:.1f} dB")
    return Trial(steps, psnrs, unedited)


def _try_approach(
    options: TrainOptions,
    way: Approach,
    setup: TrainingSetup,
    seeds: int,
    small: Evaluator,
    steps: int,
) -> float:
    """PSNR in the judging views, dB. `seeds`: how many members, the last, are none of the scene's"""
    taught = small.only([i for i in range(len(small.crops)) if i % 3 != 1])
    original = small.original
    crops = taught.crops
    targets = taught.edited[1.0]
    stage = TargetStage(1.0, targets, steps)
    if way.group_steps:
        # how far parts get as wholes; what the members add to that takes longer than a trial
        groups = group_stage(original, crops, [targets], steps, options.optimize.seed)
        end = groups.to_stages(original, crops, [stage])[0].place(torch.zeros_like(original))
    else:
        resolved = resolve_kind(with_values(options, steps=steps), way.kind, 0)
        extent = 2.0 * scene_sphere(setup.scene[setup.region.members])[1]
        settings = pgs_settings(resolved, True, original.shape[1], extent, 1)
        settings = replace(settings, smoothing=0.9, every=0, snapshots=1)
        if seeds:
            stage = place_seeds(stage, seeds)
            settings = replace(settings, ramp=0.0)
        objective = Objective(GradientL1(), OptimizeOptions(perceptual_weight=0.0))
        *_, last = optimize(original, crops, [], [stage], objective, settings)
        end = last.offsets
    return _psnr(small, end)


def resolve_approach(options: TrainOptions, way: Approach) -> OptimizeOptions:
    """See `resolve_kind`."""
    return resolve_kind(options, way.kind, way.group_steps, way.grow)


def _small_views(setup: TrainingSetup, pairs: Sequence[tuple[View, Tensor]]) -> Evaluator:
    """Views and their edited pictures, small."""
    small = [_small(setup, view.widen([picture]), picture) for view, picture in pairs]
    crops, targets, pixels = zip(*small, strict=True)
    original = pack(setup.scene[setup.region.members], with_shN=setup.scene.sh_degree > 0)
    return Evaluator(original, crops, pixels, {1.0: targets}, [view.camera.name for view, _ in pairs])


def _small(setup: TrainingSetup, view: View, picture: Tensor) -> tuple[CropScene, Tensor, Tensor]:
    """What is rendered, what it should be, and which pixels count."""
    scene, shrink, counting = shrink_view(setup, view, picture, fit_size(view.camera, _SIZE))
    return scene, shrink(picture), counting[..., 0] > 0.5


def _psnr(small: Evaluator, offsets: Tensor) -> float:
    """In the views that judge, or all where there is one alone, dB."""
    count = len(small.crops)
    judges = small.only(range(1, count, 3) or range(count))
    return judges.psnr(judges.pictures(offsets), judges.edited[1.0])


def _change(view: View, picture: Tensor) -> float:
    return float((picture - view.image).abs().mean())
