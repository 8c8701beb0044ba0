"""Perceptually uniform sliders: equal slider steps make equal visible changes.

First, the editor's strengths. An edit that rotates a hue changes the picture little at some strengths and
much at others. Pictures at equal strengths would force the slider to slow down and to jump between them. At
strengths with equal visible change, all stages are equally far apart, and s = 0.5 shows half of the change.

Last, the fitted field. It leaves out small detours of its recording, which are not spread evenly over the
slider.

The gain of each is in docs/lab/experiments.md, The slider.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from progdf.field import BakedField
from progdf.field.baked import (
    NeuralForm,
    SliderRemap,
    identity_remap,
    interpolate,
    interpolate_at,
    remap_slider,
)
from progdf.field.choose import Field
from progdf.gaussians import BASE_CHANNELS, pack
from trainer.editors import editor_row
from trainer.editors.base import ImageEditor
from trainer.editors.procedural import edit_course
from trainer.options import EditorOptions
from trainer.store.progress import RunLog
from trainer.views.boxes import probe_views
from trainer.views.crops import GEOMETRY, render_all
from trainer.views.setup import TrainingSetup
from trainer.views.view import View

from .still_path import still_path

STEPS = 20
"""Equal steps over the whole slider for which uniformity is measured."""

_EDITOR_VIEWS = 3  # views of the editor's pictures
_FIELD_VIEWS = 6  # views of the field
_COSTLY_STEPS = 8  # steps, in one view, if each picture runs a model
_STARTS_PER_STEP = 2  # number of evenly spaced offsets within a step at which measured steps start
_SPREAD_PASSES = 3  # passes that respace the strengths; the best one counts
_RENDER_ROUNDS = 2  # renders of all strengths
_JUMP_SHARE = 0.7  # with this share of the change in one step, strengths in between are unreliable


def equalized_strengths(
    editor: ImageEditor, spec: str, views: Sequence[View], plain: tuple[float, ...]
) -> tuple[float, ...]:
    """Return the strengths at which the editor's pictures reach the shares `plain` of the visible change.

    The strengths have three decimals, as they name folders; the last is 1. `plain` is returned unchanged if
    the editor has its own strengths or if the whole change is one jump. If each picture runs a model, one
    view is measured in eight steps.

    Args:
        editor: see `ImageEditor`
        spec: the editor's specification, `KIND:WHAT`
        views: up to three evenly spaced ones are measured
        plain: shares of the visible change, ascending, the last 1
    """
    if editor.stages or len(plain) == 1:
        return plain
    costly = editor_row(EditorOptions(spec)).slow_strengths
    measured_views = views[:1] if costly else views[:: max(1, len(views) // _EDITOR_VIEWS)][:_EDITOR_VIEWS]
    view_edits = [edit_course(editor, view) for view in measured_views]

    def picture_at(s: float) -> Tensor:
        pictures = [picture_at(s) for picture_at in view_edits]
        if not editor.is_confined:  # undo changes outside the region
            pictures = [view.confine(picture) for view, picture in zip(measured_views, pictures, strict=True)]
        return torch.cat([picture.flatten() for picture in pictures])

    even = torch.linspace(0, 1, (_COSTLY_STEPS if costly else STEPS) + 1, dtype=torch.float64)
    pictures = [picture_at(float(s)) for s in even]
    steps = [float((b - a).abs().mean()) for a, b in pairwise(pictures)]
    if max(steps) > _JUMP_SHARE * sum(steps):
        return plain
    _, respaced = _spread(even, pictures, 1)
    at = interpolate(torch.tensor(plain, dtype=torch.float64), even, respaced)
    rounded = (*(round(float(s), 3) for s in at[:-1]), 1.0)
    rises = all(b - a > 5e-4 for a, b in zip((0.0, *rounded), rounded, strict=False))
    return rounded if rises else plain


def equalize_slider(
    field: BakedField, setup: TrainingSetup, log: RunLog | None = None
) -> tuple[BakedField, SliderRemap]:
    """Return the field with a uniform slider, measured in training views, and the remap to it.

    A network keeps its slider.
    """
    if isinstance(field.origin, NeuralForm) or not field.attributes:
        return field, identity_remap()
    remap = equalizing_slider(field, setup, log)
    return remap_slider(field, remap), remap


def equalizing_slider(field: Field, setup: TrainingSetup, log: RunLog | None = None) -> SliderRemap:
    """Return the remap to a uniform slider of any field that moves something, measured in training views."""
    moving = list(field.attributes)
    small = probe_views(setup, _FIELD_VIEWS, still=not set(moving) & set(GEOMETRY))
    channels = field.channels if isinstance(field, BakedField) else field.offsets(1.0).shape[1]
    rows = pack(setup.scene[setup.region.members], with_shN=channels > BASE_CHANNELS)

    path = still_path(small, rows, field) or (lambda s: render_all(small, rows + field.offsets(s), moving))

    def picture_at(s: float) -> Tensor:
        looked()
        return torch.cat([picture.flatten() for picture in path(s)])

    counter: AbstractContextManager[Callable[[], None]] = nullcontext(lambda: None)
    if log is not None:
        counter = log.looks("even the slider", _RENDER_ROUNDS * (STEPS * _STARTS_PER_STEP + 1))
    with counter as looked:
        remap, uniformity = equalizing_remap(picture_at)
    if log is not None:
        log.say(f"even slider: the smallest of {STEPS} visible steps is {uniformity:.2f} of the largest")
    return remap


def equalizing_remap(seen: Callable[[float], Tensor]) -> tuple[SliderRemap, float]:
    """Return the remap under which equal steps change the pictures equally, and their uniformity, 0 to 1.

    Steps that start between the even slider values count too. Without them, a robot edit had a uniformity of
    0.93 on the even values, but 0.68 on steps that start half a step later; with them 0.92 and 0.88.

    Args:
        seen: strength -> pixels of any fixed shape; called at even strengths and at the strengths found, and
            interpolated linearly between them
    """
    even = torch.linspace(0, 1, STEPS * _STARTS_PER_STEP + 1, dtype=torch.float64)
    places = even
    for _ in range(_RENDER_ROUNDS):
        rendered_at = places
        pictures = [seen(float(s)) for s in places]
        best = -1.0
        following = places
        for _ in range(_SPREAD_PASSES + 1):
            current = following
            blended = [interpolate_at(rendered_at, pictures, float(s)) for s in current]
            uniformity, following = _spread(current, blended, _STARTS_PER_STEP)
            if uniformity > best:
                best = uniformity
                places = current
    remap = SliderRemap(places[::_STARTS_PER_STEP].contiguous(), even[::_STARTS_PER_STEP].contiguous())
    return remap, best


def _spread(places: Tensor, pictures: Sequence[Tensor], reach: int) -> tuple[float, Tensor]:
    """Measure the uniformity of steps over `reach` intervals and respace the strengths to increase it.

    Args:
        places: strengths, ascending from 0 to 1. [n+1] float64
        pictures: pixels at these strengths
        reach: intervals in a step

    Returns:
        Smallest over largest step, 0 to 1; the new strengths. [n+1]
    """
    count = len(places) - 1
    steps = [float((pictures[i + reach] - pictures[i]).abs().mean()) for i in range(count + 1 - reach)]
    if max(steps) <= 0:
        return 1.0, places
    covering = [steps[max(0, i - reach + 1) : i + 1] for i in range(count)]
    pace = [sum(c) / len(c) for c in covering]
    floor = 1e-3 * max(pace)  # keeps the strengths apart
    path_length = torch.tensor([0.0, *accumulate(max(p, floor) for p in pace)], dtype=torch.float64)
    even = torch.linspace(0, 1, count + 1, dtype=torch.float64)
    respaced = interpolate(even, path_length / path_length[-1], places)
    respaced[0] = 0.0
    respaced[-1] = 1.0
    return min(steps) / max(steps), respaced
