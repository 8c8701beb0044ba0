"""Agreement of the edited views, measured as the error of the best scene that could show them all.

Views that are edited one by one need not show the same object. No training can reproduce their differences:
it converges to the mean, which looks like fog. The agreement is therefore measured before training starts.
The geometry stays fixed and the members' colors are fitted to the change of all training views by least
squares. A render is linear in colors, so there is one solution, found in a few seconds. The share of the
change on held-out views that the fit leaves unexplained measures the disagreement.

PSNR alone does not separate agreeing from disagreeing edits; the share does. Stripes at another position in
every view hardly weigh in the share, so the fine part has a share of its own (docs/lab/experiments.md,
Editors that agree, or do not). If parts move, colors cannot follow and nothing is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.metrics.image import NO_DIFFERENCE, decibels
from progdf.rasterize import render
from progdf.system.equality import equal_fields
from trainer.editors.style import smooth
from trainer.views.boxes import shrink_view
from trainer.views.crops import CropScene
from trainer.views.setup import TrainingSetup
from trainer.views.view import View

_MAX_UNEXPLAINED = 0.4  # midway between edits that agree and edits that do not, see above
_MAX_UNEXPLAINED_FINE = 0.5  # calm styles leave up to 0.47, stripes of random phase 0.55 and more
_MIN_CONTRAST = 0.8  # washed-out views agree, but have lost fine contrast
_INVISIBLE_ERROR_DB = 28.0  # smaller errors are not visible, whatever their share of a faint change
_COMPARED_BOX_PX = 70  # longer side of the compared region's box, so that strokes have one size in all views
_CG_STEPS = 6  # steps of conjugate gradients
DAMPING = 1e-3  # share of the first step's curvature; barely visible members keep their color


@dataclass(frozen=True)
class Agreement:
    """Agreement of the edited views with one scene."""

    psnr: float  # PSNR of the best colors on held-out views, over pixels of the region or the change, dB
    unexplained: float  # share of the change's energy there that these colors do not reproduce, 0 is best
    # the same share of the fine part, which varies within 9 pixels of the shrunk view
    unexplained_fine: float = 0.0
    # fine energy of the pictures relative to that before they were made to agree; 1 if they were not
    contrast: float = 1.0

    @property
    def agree(self) -> bool:
        """True if the figures are within the range of consistent edits."""
        alike = self.unexplained <= _MAX_UNEXPLAINED and self.unexplained_fine <= _MAX_UNEXPLAINED_FINE
        return self.contrast >= _MIN_CONTRAST and (alike or self.psnr >= _INVISIBLE_ERROR_DB)

    def line(self, remedy: str, judged_on: str) -> str:
        """Return one line for the log, with advice if the views disagree.

        Args:
            remedy: advice, see `EditorRow.remedy`
            judged_on: the views of the figures, in words
        """
        share = f"{self.unexplained:.0%} of the change, {self.unexplained_fine:.0%} of its fine part"
        if self.agree:
            best = f"the best colors reach {self.psnr:.1f} dB and miss {share}"
            return f"the edited views agree: on {judged_on} {best}"
        if self.contrast < _MIN_CONTRAST:
            return (
                f"the edited views are washed out: {self.contrast:.0%} of the fine contrast that they had "
                f"before they were made to agree; {remedy}"
            )
        return (
            f"the edited views disagree: no 3D scene shows all of them, best possible {self.psnr:.1f} dB on "
            f"{judged_on}, which misses {share}; {remedy}"
        )

    def figures(self) -> dict[str, float | bool]:
        """Return the figures for report.json."""
        return {
            "psnr_best": round(self.psnr, 2),
            "unexplained": round(self.unexplained, 3),
            "unexplained_fine": round(self.unexplained_fine, 3),
            "contrast": round(self.contrast, 3),
            "agree": self.agree,
        }


@dataclass(frozen=True)
class ViewChange:
    """One view's box at a smaller size: its scene, its change, and the evaluated pixels."""

    __eq__ = equal_fields

    scene: CropScene
    change: Tensor  # edited minus original picture, times `counts`. [h,w,3]
    counts: Tensor  # 1 in evaluated pixels, else 0; times the root of the weight in a fit. [h,w,1]

    def render(self, colors: Tensor) -> Tensor:
        """Render changes of the members' colors in the evaluated pixels. [M,3] -> [h,w,3]"""
        scene = self.scene
        changes = torch.zeros_like(scene.gaussians.colors).index_copy(0, scene.rows, colors)
        changed = scene.gaussians._replace(colors=changes)
        drawn = render(changed, scene.camera, (0.0, 0.0, 0.0), crop=scene.box, grad_rows=scene.rows)
        return drawn.image * self.counts

    def residual(self, colors: Tensor) -> float:
        """Return the share of the change's energy that these colors do not reproduce. [M,3] -> 0 is best"""
        with torch.no_grad():
            missing = (self.change - self.render(colors)).square().sum()
        return float(missing / self.change.square().sum().clamp_min(1e-12))

    def weigh(self, weight: float) -> ViewChange:
        """Return the view with another weight in a fit."""
        return replace(self, change=self.change * weight**0.5, counts=self.counts * weight**0.5)

    def gather(self, picture: Tensor, members: int) -> Tensor:
        """Apply the transpose of `render`: sum a picture into the members. [h,w,3] -> [M,3]"""
        colors = torch.zeros(members, 3, requires_grad=True)
        (gradient,) = torch.autograd.grad(self.render(colors), colors, picture)
        return gradient


def measure_agreement(setup: TrainingSetup, train: Sequence[Tensor], held_out: Sequence[Tensor]) -> Agreement:
    """Fit one color change per member to the edited training views, and test it on the held-out views.

    Args:
        setup: scene, region and views
        train, held_out: edited pictures of the views, in their order. [H,W,3] each
    """
    members = len(setup.region.members)
    seen = [view_change(setup, view, edited) for view, edited in zip(setup.train, train, strict=True)]
    colors = fit_colors(seen, members)
    lost = change = count = lost_fine = fine = 0.0
    with torch.no_grad():
        for view, edited in zip(setup.judging, held_out, strict=True):
            observed = view_change(setup, view, edited)
            missed = observed.change - observed.render(colors)
            lost += float(missed.square().sum())
            lost_fine += fine_energy(missed)
            change += float(observed.change.square().sum())
            fine += fine_energy(observed.change)
            count += 3 * float(observed.counts.sum())
    if lost <= 0 or count == 0:
        return Agreement(NO_DIFFERENCE, 0.0)
    return Agreement(decibels(lost / count), lost / max(change, 1e-12), lost_fine / max(fine, 1e-12))


def fine_energy(change: Tensor) -> float:
    """Return the energy of a picture's change relative to its local mean. [H,W,3]"""
    return float((change - smooth(change)).square().sum())


def fit_colors(seen: Sequence[ViewChange], members: int) -> Tensor:
    """Fit colors by least squares with conjugate gradients (CGLS, Björck 1996). -> [M,3]"""

    def gather(pictures: Sequence[Tensor]) -> Tensor:
        parts = [view.gather(p, members) for view, p in zip(seen, pictures, strict=True)]
        return torch.stack(parts).sum(dim=0)

    colors = torch.zeros(members, 3)
    residuals = [view.change for view in seen]
    direction = slope = gather(residuals)
    damping = None
    for _ in range(_CG_STEPS):
        with torch.no_grad():
            rendered = [view.render(direction) for view in seen]
        length = float(direction.square().sum())
        curve = sum(float(p.square().sum()) for p in rendered)
        if curve <= 0:
            break
        damping = DAMPING * curve / length if damping is None else damping
        step = float(slope.square().sum()) / (curve + damping * length)
        colors = colors + step * direction
        residuals = [picture - step * p for picture, p in zip(residuals, rendered, strict=True)]
        before = float(slope.square().sum())
        slope = gather(residuals) - damping * colors
        direction = slope + float(slope.square().sum()) / before * direction
    return colors


def robust_colors(seen: Sequence[ViewChange], members: int) -> Tensor:
    """Fit colors with less weight for views that the fit of all views explains badly. -> [M,3]

    Views with a residual of up to twice the median have equal weights. No weight is 0, as such a view may be
    the only one that shows a member.
    """
    colors = fit_colors(seen, members)
    shares = torch.tensor([view.residual(colors) for view in seen])
    weights = (2 * shares.median() / shares.clamp_min(1e-12)).clamp_max(1.0).square()
    return fit_colors([view.weigh(float(w)) for view, w in zip(seen, weights, strict=True)], members)


def view_change(setup: TrainingSetup, view: View, edited: Tensor, shrink: int | None = None) -> ViewChange:
    """Return the change of a view at a fraction of its size. [H,W,3]

    `shrink`: divisor of the size; None: the longer side of the region's box becomes about `_COMPARED_BOX_PX`
    pixels, but the divisor is at least 2
    """
    if shrink is None:
        x0, y0, x1, y1 = view.box
        shrink = max(2, round(max(x1 - x0, y1 - y0) / _COMPARED_BOX_PX))
    camera = view.camera.resize(max(1, view.camera.width // shrink), max(1, view.camera.height // shrink))
    scene, small, share = shrink_view(setup, view, edited, camera)
    counting = (share > 0.5).float()
    return ViewChange(scene, small(edited - view.image) * counting, counting)
