"""Edits of colors from a handful of pictures: solved for, with the members tied to their neighbors.

A few pictures leave most members undecided: a pixel is a mixture of many, some far behind others, and what
no picture shows has no pixel at all. Least squares alone spreads the change over all of them. So neighbors on
one surface are tied (a graph Laplacian over `surface_likeness`): they change alike where the pictures do not
tell them apart, and a change travels along its surface to where no picture looks. A member behind others is
not asked by the pixels through which it hardly shines. No color leaves what can be shown: sharper edges than
the members can have would be bought with colors that shine from everywhere else. Colors change with the view
as the paint that explains the edit says (`trainer.optimize.solve_pictures`), which one view cannot tell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_matrix, diags
from torch import Tensor

from progdf.color.edits import typical_color
from progdf.color.oklab import bend_of, interpolate_colors
from progdf.gaussians import Gaussians, unpack
from progdf.rasterize.cpu.engine import ColorMap
from progdf.sh import C0, sh0_to_rgb
from progdf.threads import one_thread
from trainer.regions.lift import HIDDEN, bare_weight
from trainer.regions.surface import covered_rows, surface_likeness
from trainer.views.crops import CropScene

from .color_solver import ColorView, color_columns, color_view
from .pgs import OnStep, ParameterSnapshot, PgsState, TargetStage

_TYPICAL = 0.5
"""Of the root mean square of all changes: members that change less do not say what it is."""

_LEAST_AMOUNT = 0.3  # below this a member's change does not tell where all of it would lead
_PAINT_ROUNDS = 3

_WHOLE = 0.15
"""Share of the change's energy that one function of color may leave: stripes leave half, a fill a tenth."""

_COVERED, _TOUCHED = 0.8, 0.3
"""A change covers all where so much of what shows has changed, by so much of what is typical."""


@dataclass(frozen=True)
class Paint:
    """An edit of colors as one function."""

    full: Tensor  # change of each member where the amount is 1. [M,3]
    amounts: Tensor  # 0 untouched .. 1 all of it. [M]
    # derivative of the new color by the old one, less the old one's own, rows in, columns out. [3,3]
    slope: Tensor
    trust: float  # share of the change's energy that this explains, 0..1
    whole: bool  # the amount is 1 everywhere
    # what a function of color without amounts makes of each member, where nearly all that shows has changed;
    # else None. [M,3]
    general: Tensor | None


def fit_paint(colors: Tensor, change: Tensor, weights: Tensor) -> Paint:
    """The paint that explains the members' change.

    Args:
        colors: as they were. [M,3]
        change: of each member. [M,3]
        weights: how much each shows, ≥ 0. [M]
    """
    ones = torch.ones_like(weights)
    energy = (weights[:, None] * change.square()).sum().clamp_min(1e-30)

    def unexplained_share(full: Tensor, amounts: Tensor) -> float:
        left = change - amounts[:, None] * full
        return float((weights[:, None] * left.square()).sum() / energy)

    full, slope = _fit_affine(colors, change, weights)
    left = unexplained_share(full, ones)
    if left <= _WHOLE:
        return Paint(full, ones, slope, max(0.0, 1.0 - left), True, full)
    typical = (energy / weights.sum().clamp_min(1e-30)).sqrt()
    changed_weight = (weights * (change.norm(dim=1) > _TOUCHED * typical)).sum()
    general = full if bool(changed_weight >= _COVERED * weights.sum()) else None
    least = _TYPICAL * typical
    telling, amounts = weights * (change.norm(dim=1) > least), ones
    for _ in range(_PAINT_ROUNDS):
        divisor = amounts.clamp_min(_LEAST_AMOUNT)
        full, slope = _fit_affine(colors, change / divisor[:, None], telling * divisor.square())
        along = (change * full).sum(dim=1) / full.square().sum(dim=1).clamp_min(1e-9)
        amounts = along.clamp(0.0, 1.0)
    return Paint(full, amounts, slope, max(0.0, 1.0 - unexplained_share(full, amounts)), False, general)


def _fit_affine(colors: Tensor, change: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted least squares: the change of every member [M,3], and its derivative [3,3]."""
    x = torch.cat([colors - 0.5, torch.ones(len(colors), 1, dtype=colors.dtype)], dim=1)
    square = x.T @ (weights[:, None] * x)
    square += (1e-4 * square.diagonal().mean() + 1e-12) * torch.eye(4, dtype=colors.dtype)
    coefficients = torch.linalg.solve(square, x.T @ (weights[:, None] * change))
    return x @ coefficients, coefficients[:3]


RECORDINGS = 8
"""Of the way to the finished edit, straight in OKLab with a bow; of all strengths together."""

_TIES = 0.01
"""How strongly neighbors are tied, beside what the pictures say of a typical member."""

_RIDGE = 1e-5
"""The same for being what the paint says, or as they were."""

_LOOSE = 0.01
"""Share of the ridge that holds what no picture shows, where the change covers all, but with several paints:
what is near on the surface tells more than their mean (a panda's back is white, its arms are black)."""

_WEAKEST_TIE = 5e-3  # of all of a member's: most of its neighbors are hardly alike

_BRIGHTEST, _GLARE = 0.99, 1.0
"""The brightest: this quantile of the members' own channels, or 1. How much brighter a member may become to
outshine what is before it; the paint is fitted without that."""

_PAINTS, _ROUNDS, _GAIN = 3, 12, 2e-3
"""How often the paint is fitted; rounds of descent each time, until one gains less than this share."""

_STEPS, _EXACT, _SHORTEST = 15, 1e-2, 0.05  # of conjugate gradients; of a round's way
_FILLED = 300  # most steps of these from member to member, where no picture looks


@dataclass(frozen=True)
class PictureSolver:
    """The pictures and the ties, ready to be solved."""

    views: Sequence[ColorView]  # of the pictures; see `ColorView`
    shown: Tensor  # what the pictures say of each member, Σ w² of all pixels; 0 behind others. [M] float64
    ties: csr_matrix  # graph Laplacian, as strong as it is to be
    ridge: float  # see `_RIDGE`
    colors: Tensor  # the members' own, of DC. [M,3] float64
    bands: Tensor  # their own higher bands as far as they follow. [M,B-1,3] float64

    @property
    def unseen(self) -> int:
        """How many members no picture tells anything of."""
        return int((self.shown == 0).sum())

    @one_thread()
    def solve(self, targets: Sequence[Tensor], start: Tensor) -> Tensor:
        """The offsets of DC and bands that the pictures ask for. [M,B,3] -> [M,B,3]

        Args:
            targets: the edited boxes
            start: where to begin
        """
        change, bands = start[:, 0].double() * C0, start[:, 1:].double()
        prior = torch.zeros_like(change)
        for _ in range(_PAINTS):
            change = self._descend(change, bands, prior, targets)
            low, high = self._limits(0.0)
            paint = fit_paint(self.colors, change.clamp(low, high), self.shown)
            # where the change covers all that shows, what no picture shows follows it too
            prior = torch.zeros_like(change) if paint.general is None else paint.general
            amounts = paint.trust * paint.amounts
            bands = amounts[:, None, None] * (self.bands @ paint.slope)
        ridge = self.ridge if paint.whole or paint.general is None else _LOOSE * self.ridge
        unseen = (self.shown == 0)[:, None]
        change = self._fill(torch.where(unseen, prior, change), prior, ridge)
        change = self._descend(change, bands, prior, targets)
        return self._offsets(self._fill(change, prior, ridge), bands)

    def left(self, offsets: Tensor, targets: Sequence[Tensor]) -> tuple[float, float]:
        """Mean squared and mean absolute difference from the targets."""
        squared = absolute = count = 0.0
        for view, target in zip(self.views, targets, strict=True):
            apart = view.picture(view.colors(offsets)).clamp(0.0, 1.0) - target
            squared += float(apart.square().sum())
            absolute += float(apart.abs().sum())
            count += target.numel()
        return squared / max(1.0, count), absolute / max(1.0, count)

    def _offsets(self, change: Tensor, bands: Tensor) -> Tensor:
        return torch.cat([change[:, None] / C0, bands], dim=1).float()

    def _descend(self, change: Tensor, bands: Tensor, prior: Tensor, targets: Sequence[Tensor]) -> Tensor:
        """Projected Newton steps (Bertsekas 1982) to the change of color that fits best. [M,3] float64"""
        low, high = self._limits(_GLARE)
        change = change.clamp(low, high)
        error, apart, free = self._look(change, bands, prior, targets)
        for _ in range(_ROUNDS):
            gradient = self._transpose(apart) + self._tie(change - prior)
            held = ((change <= low) & (gradient > 0.0)) | ((change >= high) & (gradient < 0.0))
            way = self._conjugate_gradients(gradient, ~held, free)
            length, before = 1.0, error
            while length > _SHORTEST:
                tried = (change - length * way).clamp(low, high)
                error, apart, free = self._look(tried, bands, prior, targets)
                if error < before:
                    change = tried
                    break
                length *= 0.5
            if error > (1.0 - _GAIN) * before:
                break
        return change

    def _fill(self, change: Tensor, prior: Tensor, ridge: float) -> Tensor:
        """The change with that of the members which no picture shows as the ties have it: in a descent over
        the pictures it would take far too many steps to travel around a body. [M,3]"""
        unseen = (self.shown == 0).numpy()
        residual = (change - prior).numpy()
        ties = self.ties[unseen]
        inner, right_side = ties[:, unseen], -(ties[:, ~unseen] @ residual[~unseen])
        diagonal = torch.from_numpy(inner.diagonal() + ridge)[:, None]

        def apply(x: Tensor) -> Tensor:
            return torch.from_numpy(inner @ x.numpy()) + ridge * x

        start = torch.from_numpy(residual[unseen])
        left = torch.from_numpy(right_side) - apply(start)
        found = prior[unseen] + start + conjugate_gradients(apply, diagonal, left, _FILLED)
        low, high = self._limits(0.0)
        filled = change.clone()
        filled[unseen] = found.clamp(low[unseen], high[unseen])
        return filled

    def _limits(self, glare: float) -> tuple[Tensor, Tensor]:
        """How far the members' colors may change, `glare` beyond the brightest. [M,3] each"""
        most = max(1.0, float(np.quantile(self.colors.numpy(), _BRIGHTEST))) + glare
        return self.colors.clamp_max(0.0) - self.colors, self.colors.clamp_min(most) - self.colors

    def _look(
        self, change: Tensor, bands: Tensor, prior: Tensor, targets: Sequence[Tensor]
    ) -> tuple[float, list[Tensor], list[Tensor]]:
        """What a change of color leaves: half the squared error with what the ties add to it; of each picture
        the differences, and the channels in which it is not stuck at black or white. [h,w,3] each"""
        differences, free = [], []
        offsets = self._offsets(change, bands)
        for view, target in zip(self.views, targets, strict=True):
            rendered = view.picture(view.colors(offsets))
            apart = rendered.clamp(0.0, 1.0) - target
            # a clamp passes what leads back into range
            free.append(((rendered >= 0.0) | (apart < 0.0)) & ((rendered <= 1.0) | (apart > 0.0)))
            differences.append(apart)
        held = change - prior
        error = sum(float(apart.square().sum()) for apart in differences)
        masked = [apart * passed for apart, passed in zip(differences, free, strict=True)]
        return 0.5 * (error + float((held * self._tie(held)).sum())), masked, free

    def _transpose(self, images: Sequence[Tensor]) -> Tensor:
        """Of images of all views, in the colors of the members that are shown. [M,3] float64"""
        total = torch.zeros(len(self.shown), 3, dtype=torch.float64)
        for view, image in zip(self.views, images, strict=True):
            total += view.map.gradient(image)
        return total * (self.shown > 0)[:, None]

    def _tie(self, x: Tensor) -> Tensor:
        return torch.from_numpy(self.ties @ x.numpy()) + self.ridge * x

    def _conjugate_gradients(self, b: Tensor, rows: Tensor, free: Sequence[Tensor]) -> Tensor:
        """Nearly the solution x of H x = b, channel by channel, 0 but where `rows` is set. [M,3]

        Args:
            b: [M,3]
            rows: [M,3] bool
            free: channels that count, of each view. [h,w,3] bool
        """
        visible = (self.shown > 0)[:, None]
        diagonal = (self.shown + torch.from_numpy(self.ties.diagonal()) + self.ridge)[:, None]

        def apply(p: Tensor) -> Tensor:
            masked = p * visible
            pictures = [
                view.map.picture(masked) * passed for view, passed in zip(self.views, free, strict=True)
            ]
            return rows * (self._transpose(pictures) + self._tie(p))

        return conjugate_gradients(apply, diagonal, b * rows, _STEPS)


def conjugate_gradients(apply: Callable[[Tensor], Tensor], diagonal: Tensor, b: Tensor, steps: int) -> Tensor:
    """Nearly the solution x of A x = b, channel by channel, from 0. [M,3]

    Args:
        apply: x -> A x, symmetric and positive. [M,3] -> [M,3]
        diagonal: of A, or nearly. [M,1]
        b: [M,3]
        steps: at most
    """
    x, r = torch.zeros_like(b), b
    z = r / diagonal
    p, rz = z.clone(), (r * z).sum(dim=0)
    enough = _EXACT**2 * rz
    for _ in range(steps):
        if bool((rz <= enough).all()):
            break
        applied = apply(p)
        length = rz / (p * applied).sum(dim=0).clamp_min(1e-300)
        x, r = x + length * p, r - length * applied
        z = r / diagonal
        after = (r * z).sum(dim=0)
        p, rz = z + after / rz.clamp_min(1e-300) * p, after
    return x


def make_picture_solver(
    scene: Gaussians, members: Tensor, crops: Sequence[CropScene], original: Tensor, follow: bool
) -> PictureSolver:
    """Prepare.

    Args:
        scene: the original
        members: rows of the region. [M] int64
        crops: the pictures' boxes
        original: raw member rows, packed. [M,C]
        follow: the bands beyond DC follow the paint; else they stay as they are
    """
    region = unpack(original, crops[0].member_shN)
    bands = min(region.shN.shape[1], 15) if follow else 0
    views = [color_view(crop, original, 1 + bands) for crop in crops]
    evidence = torch.zeros(len(members), dtype=torch.float64)
    clear = torch.zeros(len(members), dtype=torch.float64)
    for view in views:
        squares, mean = _weights_of(view.map)
        evidence += squares
        clear = torch.maximum(clear, mean)
    hidden = clear < HIDDEN * bare_weight(scene[members].opacities).double()
    shown = evidence.masked_fill(hidden, 0.0)
    typical = float(shown.square().sum() / shown.sum().clamp_min(1e-30))
    return PictureSolver(
        views,
        shown,
        _laplacian(scene[members], covered_rows(scene, [crop.camera for crop in crops])[members])
        * (_TIES * typical),
        max(_RIDGE * typical, 1e-12),
        sh0_to_rgb(region.sh0).double(),
        region.shN[:, :bands].double(),
    )


def solve_pictures(
    original: Tensor,
    solver: PictureSolver,
    stages: Sequence[TargetStage],
    state: PgsState,
    on_step: OnStep,
) -> Iterator[ParameterSnapshot]:
    """Solve for each stage, and record the way there from the one before: straight in OKLab with the bow.

    Args:
        original: raw member rows, packed. [M,C]
        solver: the pictures
        stages: strengths ascending; their steps are the recordings of each
        state: where to go on from, changed in place; a step is a recording
        on_step: progress; here, and only here, the state is whole and may be saved

    Raises:
        FloatingPointError: a solution is not finite; the state is that of the step before.
    """
    columns = color_columns(original.shape[1], 1 + solver.bands.shape[1])
    finished = stages[-1].targets
    for index in range(state.stage, len(stages)):
        stage = stages[index]
        before = state.previous[:, columns].reshape(len(original), -1, 3)
        end = solver.solve(stage.targets, before)
        if not math.isfinite(float(end.sum())):
            raise FloatingPointError(f"the solution for strength {stage.strength:g} is not finite")
        way = _color_way(solver, before, end)
        while state.local < stage.steps:
            offsets = way((state.local + 1) / stage.steps)
            squared, state.running = solver.left(offsets, finished)
            with torch.no_grad():
                state.moved[:, columns] = offsets.flatten(1)
            state.means.add({"l2": squared, "left": state.running})
            state.step, state.local = state.step + 1, state.local + 1
            state.average.copy_(state.moved.detach())
            state.recorded += 1
            last = state.local == stage.steps
            yield ParameterSnapshot(state.step, index, last, state.average.clone(), state.means.read())
            if last:
                state.previous.copy_(state.moved.detach())
                state.stage, state.local = index + 1, 0
                on_step(state.step, state.running)
                break
            on_step(state.step, state.running)


def _color_way(solver: PictureSolver, start: Tensor, end: Tensor) -> Callable[[float], Tensor]:
    """The members' offsets at each share of the way from one strength's to the next one's. [M,B,3]"""
    own = solver.colors.float()
    first, last = own + C0 * start[:, 0], own + C0 * end[:, 0]
    inside = last.clamp(0.0, 1.0)
    weights = solver.shown.float() * (last - first).norm(dim=1)
    bend = bend_of(typical_color(first, weights), typical_color(last, weights))

    def at(share: float) -> Tensor:
        if share >= 1.0:
            return end
        colors = interpolate_colors(first, inside, share, bend) + share * (last - inside)
        offsets = torch.lerp(start, end, share)
        offsets[:, 0] = (colors - own) / C0
        return offsets

    return at


def _weights_of(weighed: ColorMap) -> tuple[Tensor, Tensor]:
    """Of each Gaussian: Σ w² over its pixels, and its mean weight there. [M] float64 each"""
    runs = weighed.runs
    rows = np.repeat(runs.rows, np.diff(runs.starts))
    weights = runs.weights.astype(np.float64)
    squares = np.bincount(rows, weights**2, weighed.count)
    mean = np.bincount(rows, weights, weighed.count) / np.bincount(rows, None, weighed.count).clip(1)
    return torch.from_numpy(squares), torch.from_numpy(mean)


def _laplacian(region: Gaussians, covered: Tensor) -> csr_matrix:
    """Of the graph of neighbors on one surface, each with ties of 1 on the mean, none through what covers a
    member. [M,M]"""
    count = len(region)
    if count < 3:
        return csr_matrix((count, count))
    near, likeness = surface_likeness(region, torch.arange(count), covered)
    alike = (likeness >= _WEAKEST_TIE).numpy()
    rows = np.repeat(np.arange(count), alike.sum(axis=1))
    ties = csr_matrix((likeness.double().numpy()[alike], (rows, near.numpy()[alike])), (count, count))
    ties = 0.5 * (ties + ties.T)
    return csr_matrix(diags(np.asarray(ties.sum(axis=1)).ravel()) - ties)
