"""Do the edited views agree? The error of the best scene that could show them all.

Where views were edited one by one, nothing makes them show the same thing, and what they show differently no
training can reach: it settles on the mean, which looks like fog, and the trainer is blamed. So it is measured
before training starts. The geometry stays and the members' colors are fitted to the change of all training
views by least squares: a render is linear in colors, so there is one answer, found in a few seconds. What
the fit leaves of the change on held-out views tells whether the views agree.

PSNR alone does not tell the two apart, the share does; but stripes that lie elsewhere in every view hardly
weigh in it, so it is measured of the fine part by itself too (docs/experiments.md, Editors that agree, or do
not).
Where parts move, colors cannot follow, and nothing is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.metrics.image import NO_DIFFERENCE, decibels
from progdf.rasterize import render
from trainer.editors.style import smooth
from trainer.setup import TrainingSetup, shrink_view
from trainer.views.crops import CropScene
from trainer.views.view import View

_MAX_UNEXPLAINED = 0.4  # half way between the edits that agree and those that do not, see above
_MAX_FINE = 0.5  # calm styles leave up to .47, stripes of random phase .55 and more
_MIN_CONTRAST = 0.8  # what is washed out agrees, at less than what it had
_HARMLESS_DB = 28.0  # what differs by less is not seen, whatever its share of a faint change
_REMEDIES = {
    "style": "use a calmer style (14, 23, 20, 7)",
    "instruct": "say in the sentence what it leaves open, or --kind geometry if parts move",
    "folder": "edit the views more alike, or say --kind geometry if parts move",
}
_ROUNDS = 6
DAMPING = 1e-3  # of the first round's curvature: members that hardly show keep their color


@dataclass(frozen=True)
class Agreement:
    """How well one scene can show all the edited views."""

    psnr: float  # of the best colors on held-out views, over the pixels that show the region or change, dB
    unexplained: float  # what those colors leave of the change there, as a share of its energy, 0 is best
    # the same of its fine part, what varies within 9 pixels at half size
    unexplained_fine: float = 0.0
    # fine energy of the pictures over what they had before they were made to agree, where they were
    contrast: float = 1.0

    @property
    def agree(self) -> bool:
        """Whether that is what edits that are the same from everywhere leave."""
        alike = self.unexplained <= _MAX_UNEXPLAINED and self.unexplained_fine <= _MAX_FINE
        return self.contrast >= _MIN_CONTRAST and (alike or self.psnr >= _HARMLESS_DB)

    def line(self, editor: str, judged_on: str) -> str:
        """One line for the log, with advice where the views disagree.

        Args:
            editor: its kind
            judged_on: the views that the figures are of, in words
        """
        share = f"{self.unexplained:.0%} of the change, {self.unexplained_fine:.0%} of its fine part"
        if self.agree:
            best = f"the best colors reach {self.psnr:.1f} dB and miss {share}"
            return f"the edited views agree: on {judged_on} {best}"
        remedy = _REMEDIES.get(editor, "mend them")
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
        """As report.json has it."""
        return {
            "psnr_best": round(self.psnr, 2),
            "unexplained": round(self.unexplained, 3),
            "unexplained_fine": round(self.unexplained_fine, 3),
            "contrast": round(self.contrast, 3),
            "agree": self.agree,
        }


@dataclass(frozen=True)
class ViewChange:
    """One view's box at a smaller size: what it can show, its change, and which pixels count."""

    scene: CropScene
    change: Tensor
    counts: Tensor

    def render(self, colors: Tensor) -> Tensor:
        """The picture that changes of the members' colors make, where it counts. [M,3] -> [h,w,3]"""
        scene = self.scene
        changes = torch.zeros_like(scene.gaussians.colors).index_copy(0, scene.rows, colors)
        changed = scene.gaussians._replace(colors=changes)
        drawn = render(changed, scene.camera, (0.0, 0.0, 0.0), crop=scene.box, grad_rows=scene.rows)
        return drawn.image * self.counts

    def residual(self, colors: Tensor) -> float:
        """Share of the change's energy that the picture of these colors leaves. [M,3] -> 0 is best"""
        with torch.no_grad():
            missing = (self.change - self.render(colors)).square().sum()
        return float(missing / self.change.square().sum().clamp_min(1e-12))

    def weigh(self, weight: float) -> ViewChange:
        """The view with another say in a fit."""
        return replace(self, change=self.change * weight**0.5, counts=self.counts * weight**0.5)

    def gather(self, picture: Tensor, members: int) -> Tensor:
        """The transpose of `render`: what each member gets of a picture. [h,w,3] -> [M,3]"""
        colors = torch.zeros(members, 3, requires_grad=True)
        (gradient,) = torch.autograd.grad(self.render(colors), colors, picture)
        return gradient


def measure_agreement(setup: TrainingSetup, train: Sequence[Tensor], held_out: Sequence[Tensor]) -> Agreement:
    """Fit one change of color per member to the edited training views, and look at the held-out ones.

    Args:
        setup: scene, region and views
        train, held_out: their edited pictures, in their order. [H,W,3] each
    """
    members = len(setup.region.members)
    seen = [view_change(setup, view, edited) for view, edited in zip(setup.train, train, strict=True)]
    colors = fit_colors(seen, members)
    lost = change = count = lost_fine = fine = 0.0
    with torch.no_grad():
        for view, edited in zip(setup.judging, held_out, strict=True):
            one = view_change(setup, view, edited)
            missed = one.change - one.render(colors)
            lost += float(missed.square().sum())
            lost_fine += fine_energy(missed)
            change += float(one.change.square().sum())
            fine += fine_energy(one.change)
            count += 3 * float(one.counts.sum())
    if lost <= 0 or count == 0:
        return Agreement(NO_DIFFERENCE, 0.0)
    return Agreement(decibels(lost / count), lost / max(change, 1e-12), lost_fine / max(fine, 1e-12))


def fine_energy(change: Tensor) -> float:
    """Energy of what differs from the mean of the pixels around, of a change of a picture. [H,W,3]"""
    return float((change - smooth(change)).square().sum())


def fit_colors(seen: Sequence[ViewChange], members: int) -> Tensor:
    """Least squares by conjugate gradients on the normal equations (CGLS, Björck 1996). -> [M,3]"""

    def gather(pictures: Sequence[Tensor]) -> Tensor:
        parts = [one.gather(p, members) for one, p in zip(seen, pictures, strict=True)]
        return torch.stack(parts).sum(dim=0)

    colors = torch.zeros(members, 3)
    left = [one.change for one in seen]
    direction = slope = gather(left)
    damping = None
    for _ in range(_ROUNDS):
        with torch.no_grad():
            rendered = [one.render(direction) for one in seen]
        length = float(direction.square().sum())
        curve = sum(float(p.square().sum()) for p in rendered)
        if curve <= 0:
            break
        damping = DAMPING * curve / length if damping is None else damping
        step = float(slope.square().sum()) / (curve + damping * length)
        colors = colors + step * direction
        left = [picture - step * p for picture, p in zip(left, rendered, strict=True)]
        before = float(slope.square().sum())
        slope = gather(left) - damping * colors
        direction = slope + float(slope.square().sum()) / before * direction
    return colors


def robust_colors(seen: Sequence[ViewChange], members: int) -> Tensor:
    """`fit_colors` in which a view has the less say the less the fit of all explains it. -> [M,3]

    All count alike whose residual is up to twice the median. None goes without a say, as a member that no
    other view shows gets its color from there.
    """
    colors = fit_colors(seen, members)
    shares = torch.tensor([one.residual(colors) for one in seen])
    weights = (2 * shares.median() / shares.clamp_min(1e-12)).clamp_max(1.0).square()
    return fit_colors([one.weigh(float(w)) for one, w in zip(seen, weights, strict=True)], members)


def view_change(setup: TrainingSetup, view: View, edited: Tensor, shrink: int = 2) -> ViewChange:
    """The change of a view at a fraction of its size. [H,W,3]"""
    camera = view.camera.resize(max(1, view.camera.width // shrink), max(1, view.camera.height // shrink))
    scene, small, share = shrink_view(setup, view, edited, camera)
    counting = (share > 0.5).float()
    return ViewChange(scene, small(edited - view.image) * counting, counting)
