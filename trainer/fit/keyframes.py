"""Two keyframes, the strongest simple slider: each Gaussian goes straight from the original to the full edit.

Its color goes straight in raw parameters, or in OKLab from every direction. The slider is re-timed like that
of the field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from progdf.color.oklab import oklab_to_srgb, srgb_to_oklab
from progdf.field import BakedField
from progdf.field.baked import SliderRemap, identity_remap
from progdf.field.grade import member_bands, sphere
from progdf.gaussians import BASE_CHANNELS, attribute_slices, pack
from progdf.system.equality import equal_fields
from progdf.threads import map_threads
from trainer.views.setup import TrainingSetup

from .evaluate import Evaluator
from .slider_uniformity import equalizing_slider

_OKLAB_KNOTS = 5
"""Knots of a path in OKLab that is re-timed; between them the path is taken as straight."""
_BLOCK = 2048  # members whose colors from all directions fit into a processor's cache


@dataclass(frozen=True)
class TwoKeyframes:
    """Two keyframes of all members, a `Field`. Values that are no colors are interpolated linearly."""

    __eq__ = equal_fields

    start: Tensor  # packed rows of the original. [M,C]
    end: Tensor  # offsets at strength 1. [M,C]
    attributes: tuple[str, ...]  # names of the attributes that change
    in_oklab: bool  # color from every direction: straight in OKLab, or in raw parameters
    timing: SliderRemap = identity_remap()  # from slider values to strengths on the line

    @property
    def knots(self) -> Tensor:
        """Strengths between which a path of colors is nearly straight, ascending from 0 to 1. [S] float64"""
        return torch.linspace(0, 1, _OKLAB_KNOTS if self.in_oklab else 2, dtype=torch.float64)

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
        change = self._path.change(s).flatten(1)
        first = BASE_CHANNELS - 3  # column of band 0
        moved[:, first : first + change.shape[1]] = change
        return moved

    @cached_property
    def _path(self) -> _OklabPath:
        return _OklabPath(member_bands(self.start), member_bands(self.start + self.end))


_Colors = tuple[Tensor, Tensor]
"""Colors in OKLab, and their part outside the range of a screen. [M,D,3] each"""


class _OklabPath:
    """SH coefficients whose colors lie between two others, straight in OKLab from every direction.

    The colors of both ends from every direction stay in memory, 768 bytes per member.

    Args:
        before, after: coefficients of the ends. [M,B,3]
    """

    def __init__(self, before: Tensor, after: Tensor) -> None:
        degree = math.isqrt(before.shape[1]) - 1
        self._before = before
        self._functions, self._inverse = sphere(degree, before.device)

        def ends(begin: int) -> tuple[_Colors, _Colors]:
            block = slice(begin, begin + _BLOCK)
            return self._colors(before[block]), self._colors(after[block])

        self._ends = map_threads(ends, range(0, len(before), _BLOCK))

    def change(self, share: float) -> Tensor:
        """Return the change of the coefficients at a share of `after`, 0 to 1. -> [M,B,3]"""
        return torch.cat(map_threads(lambda ends: self._mix(*ends, share), self._ends)) - self._before

    def _colors(self, sh: Tensor) -> _Colors:
        """Return the colors from every direction in OKLab, and their part outside the range of a screen."""
        rgb = torch.einsum("db,mbc->mdc", self._functions, sh) + 0.5
        shown = rgb.clamp(0.0, 1.0)
        return srgb_to_oklab(shown), rgb - shown

    def _mix(self, before: _Colors, after: _Colors, share: float) -> Tensor:
        lab = torch.lerp(before[0], after[0], share)
        beyond = torch.lerp(before[1], after[1], share)  # what a screen cannot show is interpolated linearly
        return torch.einsum("bd,mdc->mbc", self._inverse, oklab_to_srgb(lab) + beyond - 0.5)


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
