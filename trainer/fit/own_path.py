"""An edit of one target: does it keep the way that its training took, or go straight?

Nobody said what lies between original and end, and an optimizer's way there need not be shown: it
takes bytes, and looks worse half way than a blend as often as not. So it has to be nearer to the editor's own
picture of the half, where the editor has one; parts that move as wholes keep their way, on which they stay
whole. Everything else goes straight, which are two keyframes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from progdf.field.trajectory import Trajectory
from trainer.editors.base import ImageEditor
from trainer.setup import TrainingSetup
from trainer.views.choose import split_held_out

from .evaluate import make_evaluator

_VIEWS = 3
_BETTER = 0.5  # dB by which the own way has to be nearer: it takes several times the bytes
_HALFWAY = (0.3, 0.4, 0.5, 0.6, 0.7)  # a way is judged where it comes nearest to the half
_SAME = 40.0  # dB above which two ways look alike


def straight_path(trajectory: Trajectory) -> Trajectory:
    """The two ends alone."""
    ends = [0, len(trajectory) - 1]
    return replace(
        trajectory,
        s=torch.tensor([0.0, 1.0]),
        offsets=trajectory.offsets[ends],
        steps=trajectory.steps[ends],
        stage_ends=(1,),
    )


def choose_path(
    trajectory: Trajectory,
    setup: TrainingSetup,
    editor: ImageEditor | None,
    in_parts: bool,
    retimed: Callable[[Trajectory], Trajectory],
) -> tuple[Trajectory, str]:
    """The trajectory or its straight line, and why, in words.

    Args:
        trajectory: of one target, as recorded
        setup: scene, region, and the held-out views, of which those that fields are chosen on judge
        editor: what made the edited views; None where it pictures no half
        in_parts: connected parts were moved as wholes
        retimed: lays the slider over a trajectory; done only where its own way may be kept
    """
    line = straight_path(trajectory)
    if not in_parts and (editor is None or editor.stages):
        return line, "straight: the editor pictures the end alone"
    trajectory = retimed(trajectory)
    views = split_held_out(setup.judging)[0][:_VIEWS]
    halves = {}
    if editor is not None and not in_parts:
        halves = {0.5: [editor.edit(view, 0.5) for view in views]}
    evaluator = make_evaluator(
        setup.scene, setup.region, views, halves, setup.background, trajectory.end.shape[1]
    )
    if in_parts:
        apart = evaluator.psnr(evaluator.pictures(trajectory.at(0.5)), evaluator.pictures(line.at(0.5)))
        if apart >= _SAME:
            return line, f"straight, which looks the same half way ({apart:.1f} dB)"
        return trajectory, f"as the parts move, which straight lines would distort ({apart:.1f} dB half way)"

    def nearest(way: Trajectory) -> float:
        return max(evaluator.psnr(evaluator.pictures(way.at(s)), evaluator.edited[0.5]) for s in _HALFWAY)

    own, direct = nearest(trajectory), nearest(line)
    found = (
        f"the editor's half is met to {own:.1f} dB by the recorded way, to {direct:.1f} dB by a straight one"
    )
    return (trajectory, f"as recorded: {found}") if own >= direct + _BETTER else (line, f"straight: {found}")
