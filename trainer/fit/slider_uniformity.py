"""Equal steps of a slider that look equally large: of an editor's own pictures, and of a fitted field.

The editor first: an edit that turns a hue shows little at some strengths and much at others. Asked at even
strengths, its pictures are pins between which a slider has to creep and to leap; asked at strengths that are
evenly visible, every stage is as far from the last as the others, and s = .5 is half of what there is to see.
The field last: it is not its recording, whose small detours it leaves out, and these are not spread evenly
over the slider. What each brings is in docs/experiments.md,
The slider.
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
from progdf.gaussians import BASE_CHANNELS, pack
from trainer.editors import COSTLY_STRENGTHS, check_editor
from trainer.editors.base import ImageEditor
from trainer.editors.procedural import edit_course
from trainer.setup import TrainingSetup, probe_views
from trainer.store.progress import RunLog
from trainer.views.crops import GEOMETRY, render_all
from trainer.views.view import View

STEPS = 20
"""Equal steps that a user makes over the whole slider."""

_ASKED_VIEWS = 3
_FIELD_VIEWS = 6
_COSTLY_STEPS = 8  # of the anchor view, where each picture costs a model's work
_FINE = 2  # a step may begin at so many places per step
_PASSES = 3  # of spreading the strengths; the best of all wins
_LOOKS = 2  # how often all places are looked at
_JUMP = 0.7  # of the change in one step of an editor's strength: no strength between can be relied on


def equalized_strengths(
    editor: ImageEditor, spec: str, views: Sequence[View], plain: tuple[float, ...]
) -> tuple[float, ...]:
    """Strengths at which the editor's own pictures are as far along as `plain` says, the last 1.

    Three decimals each, as they name folders. `plain` itself where the editor has strengths of its own,
    or where the whole change is one jump. Where each picture costs a model's work, one view is looked at in
    eight steps.

    Args:
        editor: see `ImageEditor`
        spec: what it was made of, `KIND:WHAT`
        views: of which a few are looked at
        plain: shares of the visible change, ascending, the last 1
    """
    if editor.stages or len(plain) == 1:
        return plain
    costly = check_editor(spec)[0] in COSTLY_STRENGTHS
    few = views[:1] if costly else views[:: max(1, len(views) // _ASKED_VIEWS)][:_ASKED_VIEWS]
    courses = [edit_course(editor, view) for view in few]

    def picture_at(s: float) -> Tensor:
        pictures = [picture_at(s) for picture_at in courses]
        if not editor.is_confined:  # what changes beside the region is put back
            pictures = [view.confine(picture) for view, picture in zip(few, pictures, strict=True)]
        return torch.cat([picture.flatten() for picture in pictures])

    even = torch.linspace(0, 1, (_COSTLY_STEPS if costly else STEPS) + 1, dtype=torch.float64)
    pictures = [picture_at(float(s)) for s in even]
    steps = [float((b - a).abs().mean()) for a, b in pairwise(pictures)]
    if max(steps) > _JUMP * sum(steps):
        return plain
    _, due = _spread(even, pictures, 1)
    at = interpolate(torch.tensor(plain, dtype=torch.float64), even, due)
    rounded = (*(round(float(s), 3) for s in at[:-1]), 1.0)
    rises = all(b - a > 5e-4 for a, b in zip((0.0, *rounded), rounded, strict=False))
    return rounded if rises else plain


def equalize_slider(
    field: BakedField, setup: TrainingSetup, log: RunLog | None = None
) -> tuple[BakedField, SliderRemap]:
    """The field with a slider whose equal steps look equally large in training views, and where it all went.

    A network keeps its slider.
    """
    if isinstance(field.origin, NeuralForm) or not field.attributes:
        return field, identity_remap()
    moving = list(field.attributes)
    small = probe_views(setup, _FIELD_VIEWS, still=not set(moving) & set(GEOMETRY))
    rows = pack(setup.scene[setup.region.members], with_shN=field.channels > BASE_CHANNELS)

    def picture_at(s: float) -> Tensor:
        looked()
        return torch.cat([p.flatten() for p in render_all(small, rows + field.offsets(s), moving)])

    counter: AbstractContextManager[Callable[[], None]] = nullcontext(lambda: None)
    if log is not None:
        counter = log.looks("even the slider", _LOOKS * (STEPS * _FINE + 1))
    with counter as looked:
        remap = equalizing_remap(picture_at)
    return remap_slider(field, remap), remap


def equalizing_remap(seen: Callable[[float], Tensor]) -> SliderRemap:
    """The remap under which equal steps change what is seen equally, wherever they begin.

    Steps that begin between those of a ruler count as well: without them only the ruler's own get even (of a
    robot's .93, but .68 where they begin half a step later; with them .92 and .88).

    Args:
        seen: strength -> what is seen, any fixed shape; asked at even strengths and those found, and taken
            to go straight between two of them
    """
    even = torch.linspace(0, 1, STEPS * _FINE + 1, dtype=torch.float64)
    places = even
    for _ in range(_LOOKS):
        looked = places
        pictures = [seen(float(s)) for s in places]
        best = -1.0
        following = places
        for _ in range(_PASSES + 1):
            current = following
            blended = [interpolate_at(looked, pictures, float(s)) for s in current]
            uniformity, following = _spread(current, blended, _FINE)
            if uniformity > best:
                best = uniformity
                places = current
    return SliderRemap(places[::_FINE].contiguous(), even[::_FINE].contiguous())


def _spread(places: Tensor, pictures: Sequence[Tensor], reach: int) -> tuple[float, Tensor]:
    """How even steps over `reach` intervals are, and as many places at which they should be more so.

    Args:
        places: strengths, ascending from 0 to 1. [n+1] float64
        pictures: what is seen there
        reach: intervals in a step

    Returns:
        Smallest over largest step, 0..1; the new places. [n+1]
    """
    count = len(places) - 1
    steps = [float((pictures[i + reach] - pictures[i]).abs().mean()) for i in range(count + 1 - reach)]
    if max(steps) <= 0:
        return 1.0, places
    covering = [steps[max(0, i - reach + 1) : i + 1] for i in range(count)]
    pace = [sum(c) / len(c) for c in covering]
    floor = 1e-3 * max(pace)  # so that the places stay apart
    way = torch.tensor([0.0, *accumulate(max(p, floor) for p in pace)], dtype=torch.float64)
    even = torch.linspace(0, 1, count + 1, dtype=torch.float64)
    due = interpolate(even, way / way[-1], places)
    due[0] = 0.0
    due[-1] = 1.0
    return min(steps) / max(steps), due
