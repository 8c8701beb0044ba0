"""Ideal painter: the exact denoiser of a family of edits, for tests of consistent views.

A picture is one of K edits of its view, equally likely or weighted by a reference. Its noise decides early
which, as in a trained model. The steps are Euler steps of a flow, x = (1 − σ) picture + σ noise.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.color.oklab import oklab_to_srgb
from progdf.rasterize import Crop
from tests.helpers.trained import Small
from trainer.editors import make_editor
from trainer.editors.painter import PaintRequest
from trainer.editors.procedural import StripesEditor
from trainer.options import EditorOptions
from trainer.views.view import View

STEPS = 28
STRIPES = 3  # over the height of the region
UP = torch.tensor([0.0, 1.0, 0.0])


class WholeViews:
    """Painter of whole views at their own size; see `FramePainter`."""

    has_start = True
    has_strength = True
    degrees: tuple[str, ...] = ()
    workers = 1

    def frame(self, view: View) -> tuple[Crop, Camera]:
        """Return the whole view."""
        return (0, 0, view.camera.width, view.camera.height), view.camera

    def original(self, view: View) -> Tensor:
        """See `FramePainter.original`."""
        return view.image

    def paste(self, view: View, painted: Tensor) -> Tensor:
        """See `FramePainter.paste`."""
        return painted


@dataclass
class IdealPainter(WholeViews):
    """Painter of the given views.

    Choice k of K is at the angle 2π k / K.
    """

    views: Sequence[View]
    choices: Sequence[Tensor]  # edits of each view. [K,H,W,3]
    references: int = 2
    reach: float = math.radians(33)  # standard deviation about the choice of the references
    scale: float = 0.25  # scale of the pictures against the noise
    alone: bool = True  # each view has its own noise and decides independently
    calls: int = 0
    chosen: list[int] = field(default_factory=list)

    def view_of(self, picture: Tensor) -> int:
        """Return the index of the view of a picture."""
        return next(i for i, v in enumerate(self.views) if torch.equal(v.image, picture))

    def paint(self, request: PaintRequest) -> Tensor:
        """See `FramePainter.paint`."""
        self.calls += 1
        picture = request.picture
        source = request.source
        strength = request.strength
        softness = request.softness
        seed = request.seed
        index = self.view_of(picture)
        inside = self.views[index].mask > 0.05
        edits = self.choices[index][:, inside].flatten(1) * self.scale  # [K,D]
        start = (picture if source is None else source)[inside].flatten() * self.scale
        prior = self.prior(index, request.references)
        noise = np.random.default_rng([int(seed or 0), index * self.alone]).standard_normal(picture.shape)
        x = torch.from_numpy(noise).float()[inside].flatten()
        painted = start
        for step in range(STEPS):
            sigma = 1 - step / STEPS
            after = 1 - (step + 1) / STEPS
            misfit = (x - (1 - sigma) * edits).square().sum(dim=1) / (2 * sigma**2)
            finished = torch.softmax(prior - misfit, dim=0) @ edits
            weight = min(1.0, max(0.0, (strength * (1 + softness) - sigma) / softness))
            painted = weight * finished + (1 - weight) * start
            x = x + (after - sigma) * (x - painted) / sigma
        image = picture.clone()
        image[inside] = painted.unflatten(0, (-1, 3)) / self.scale
        return image

    def prior(self, index: int, references: Sequence[Tensor]) -> Tensor:
        """Return the log probability of each choice. [K]"""
        count = len(self.choices[0])
        direction = sum((self.direction(index, reference) for reference in references), 0j)
        if abs(direction) < 1e-3:
            return torch.zeros(count)
        angles = torch.arange(count) * (2 * math.pi / count)
        apart = (angles - math.atan2(direction.imag, direction.real) + math.pi) % (2 * math.pi) - math.pi
        return -0.5 * (apart / self.reach).square()

    def direction(self, index: int, reference: Tensor) -> complex:
        """Return the choice in a reference, as a unit vector times the edited share of the region.

        The reference is a picture of the view that it equals outside the region, or else of this view.
        """
        beside = [v.mask < 1e-3 for v in self.views]
        of = index
        for i, view in enumerate(self.views):
            if torch.allclose(reference[beside[i]], view.image[beside[i]], rtol=0, atol=2 / 255):
                of = i
        view = self.views[of]
        changed = (reference - view.image).abs().amax(dim=2) > 0.02
        misfit = (self.choices[of][:, changed] - reference[changed]).square().flatten(1).sum(dim=1)
        share = float(changed.sum() / (view.mask > 0.05).sum())
        return share * cmath.exp(2j * math.pi * int(misfit.argmin()) / len(self.choices[0]))


Edit = Callable[[View, float], Tensor]
"""Edited picture of a view at a strength. [H,W,3]"""


def hues(case: Small, count: int) -> list[Tensor]:
    """Return each view recolored in `count` hues of one lightness, all around. [K,H,W,3] each"""
    return finished_edits(case, hue_edits(case, count))


def phases(case: Small, count: int) -> list[Tensor]:
    """Return each view with level stripes at `count` phases. [K,H,W,3] each"""
    return finished_edits(case, phase_edits(case, count))


def finished_edits(case: Small, edits: Sequence[Edit], strength: float = 1.0) -> list[Tensor]:
    """Return each view with all edits at a strength. [K,H,W,3] each"""
    return [torch.stack([edit(view, strength) for edit in edits]) for view in case.views]


def hue_edits(case: Small, count: int) -> list[Edit]:
    """Return the edits of `hues`."""
    edits: list[Edit] = []
    for k in range(count):
        angle = 2 * math.pi * k / count
        rgb = oklab_to_srgb(torch.tensor([0.62, 0.12 * math.cos(angle), 0.12 * math.sin(angle)]))
        spec = "recolor:#" + "".join(f"{round(255 * float(channel)):02x}" for channel in rgb.clamp(0, 1))
        edits.append(make_editor(EditorOptions(spec), case.scene, case.region, case.views).edit)
    return edits


def phase_edits(case: Small, count: int) -> list[Edit]:
    """Return the edits of `phases`."""
    editor = make_editor(EditorOptions("stripes:#f0f0ff"), case.scene, case.region, case.views)
    assert isinstance(editor, StripesEditor)
    heights = case.scene.means[case.region.members] @ UP
    period = float(torch.quantile(heights, 0.98) - torch.quantile(heights, 0.02)) / STRIPES
    patterns = [0.5 + 0.5 * torch.cos(2 * math.pi * (heights / period + k / count)) for k in range(count)]

    def edit(view: View, strength: float, pattern: Tensor) -> Tensor:
        return replace(editor, pattern=pattern).edit(view, 0.6 * strength)

    return [partial(edit, pattern=pattern) for pattern in patterns]
