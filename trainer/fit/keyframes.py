"""Two keyframes, the strongest simple slider: each Gaussian goes straight from the original to the full edit.

Its color goes straight in raw parameters, or in OKLab from every direction. The slider is re-timed like that
of the field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.color.oklab import oklab_to_srgb, srgb_to_oklab
from progdf.field import BakedField
from progdf.field.baked import SliderRemap, identity_remap
from progdf.field.grade import member_bands, sphere
from progdf.gaussians import BASE_CHANNELS, attribute_slices, pack
from trainer.views.setup import TrainingSetup

from .evaluate import Evaluator
from .slider_uniformity import equalizing_slider


@dataclass(frozen=True)
class TwoKeyframes:
    """Two keyframes of all members, a `Field`. Values that are no colors are interpolated linearly."""

    start: Tensor  # packed rows of the original. [M,C]
    end: Tensor  # offsets at strength 1. [M,C]
    attributes: tuple[str, ...]  # names of the attributes that change
    in_oklab: bool  # color from every direction: straight in OKLab, or in raw parameters
    timing: SliderRemap = identity_remap()  # from slider values to strengths on the line

    @property
    def bytes_per_member(self) -> float:
        """Bytes per member that the second keyframe takes in float32."""
        columns = attribute_slices(self.end.shape[1])
        width = 0
        for name in self.attributes:
            width += columns[name].stop - columns[name].start
        return 4.0 * width

    def offsets(self, s: float) -> Tensor:
        """Return the offsets at a slider value, see `Field`. [M,C]"""
        s = self.timing.at(s)
        moved = s * self.end
        if not self.in_oklab or s in (0.0, 1.0) or not {"sh0", "shN"} & set(self.attributes):
            return moved
        before = member_bands(self.start)
        after = member_bands(self.start + self.end)
        change = (_mix_in_oklab(before, after, s) - before).flatten(1)
        first = BASE_CHANNELS - 3  # column of band 0
        moved[:, first : first + change.shape[1]] = change
        return moved


def _mix_in_oklab(before: Tensor, after: Tensor, s: float) -> Tensor:
    """Return the SH coefficients whose colors lie between two others, straight in OKLab from every direction.

    Args:
        before, after: coefficients of the ends. [M,B,3]
        s: share of `after`, 0 to 1
    """
    degree = math.isqrt(before.shape[1]) - 1
    functions, inverse = sphere(degree, before.device)
    start = torch.einsum("db,mbc->mdc", functions, before) + 0.5
    end = torch.einsum("db,mbc->mdc", functions, after) + 0.5
    start_rgb = start.clamp(0.0, 1.0)
    end_rgb = end.clamp(0.0, 1.0)
    lab = torch.lerp(srgb_to_oklab(start_rgb), srgb_to_oklab(end_rgb), s)
    # the part outside the range of a screen is interpolated linearly
    beyond = torch.lerp(start - start_rgb, end - end_rgb, s)
    return torch.einsum("bd,mdc->mbc", inverse, oklab_to_srgb(lab) + beyond - 0.5)


def closest_keyframes(
    field: BakedField,
    setup: TrainingSetup,
    evaluator: Evaluator,
    stages: Sequence[tuple[float, float]],
    is_even: bool,
) -> TwoKeyframes:
    """Return the two keyframes, raw or in OKLab, that are closer to the editor's pictures.

    Args:
        field: the shipped field, which gives the full edit
        setup: training views, in which the slider is re-timed
        evaluator: held-out views; they choose in favor of the keyframes
        stages: slider value and strength of each set of the editor's pictures
        is_even: True if equal steps of the field's slider change the pictures equally; the keyframes are then
            re-timed to do the same
    """
    start = pack(setup.scene[setup.region.members], with_shN=field.channels > BASE_CHANNELS)
    line = TwoKeyframes(start, field.offsets(1.0), tuple(field.attributes), in_oklab=False)
    candidates = [line]
    if "sh0" in field.attributes:
        candidates.append(replace(line, in_oklab=True))
    if is_even and field.attributes:
        candidates = [_retime(one, setup) for one in candidates]
    between = [(s, evaluator.edited[at]) for s, at in stages if s < 1.0 and at in evaluator.edited]

    def error(keyframes: TwoKeyframes) -> float:
        return sum(evaluator.mse(evaluator.pictures(keyframes.offsets(s)), edited) for s, edited in between)

    # without pictures between the ends, OKLab is the usual way to mix colors
    return min(candidates, key=error) if between else candidates[-1]


def _retime(keyframes: TwoKeyframes, setup: TrainingSetup) -> TwoKeyframes:
    """Return the keyframes with a slider whose equal steps change the training views equally."""
    remap = equalizing_slider(keyframes, setup)
    return replace(keyframes, timing=SliderRemap(remap.new, remap.old))
