"""Edits of colors alone: one map of color for the region, and what single members need beside it.

While nothing moves, every training view is linear in the members' colors (`progdf.rasterize.cpu.engine`), but
for the clamps at black and white. The map, a polynomial of what is drawn (`progdf.field.grade`), is linear in
its coefficients too: its least squares over all views take a tenth of a second. What the map cannot say is a
residual of the members' lowest bands, by conjugate gradients that know the clamps, each
member preconditioned by its own weight, as in tomography: one that is a hundredth of a pixel gets its answer
as a large one does. A member that no view shows follows the map.

How much of this a region gets (degree of the map; no residual, one of DC, or one of two bands) is decided on
views that are not solved for, at the full strength: the least of which more would take away less than a
twentieth of the error. They also say when a strength has had enough steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from progdf.field.baked import MONOMIALS, identity_map
from progdf.field.grade import MOST_COLOR, band_offsets, map_colors, member_bands, monomials
from progdf.gaussians import attribute_slices, unpack
from progdf.metrics.image import decibels
from progdf.rasterize.cpu.engine import ColorMap, color_map
from progdf.sh import basis
from progdf.threads import one_thread, threads
from trainer.views.crops import CropScene

from .losses import l1
from .pgs import OnStep, ParameterSnapshot, PgsState, TargetStage

STEPS_OF_OTHERS = 8
"""Steps of an optimizer that looks at one view at a time which one iteration over all views stands for."""

MORE_PAYS = 0.95
"""Share of the error that a larger model must leave at most, to be worth its bytes."""

SETTLED = 0.001
"""Share of the error in views not solved for that a step takes away at least, for another to follow."""

ROUNDING = 1 / 255**2 / 12
"""Mean squared error of a picture of 8 bits: what is nearer to it than this is not told apart."""

STEPS = "steps"
"""Of a recording's means: the steps that it took."""

_RIDGE = 0.002  # of a typical member's weight: holds the residual of what hardly shows at 0
_MAP_RIDGE = 1e-6  # the same of the map's coefficients, for regions of few colors
_MAP_HELD = 1e-2  # say of the members' own colors beside the pixels: there a map is held to the affine one
_COVERED = 0.05  # the region's weight in a pixel that the map is fitted to
_MOST_PIXELS = 250_000  # for the some twenty coefficients of the map; of more, evenly spread ones
_CLAMP_ROUNDS = 3  # of the map's least squares, for pixels that are white or black anyway
_SHARES = (1.0, 0.5, 0.2)  # of a step, where the whole of it would run into clamps
_LOOKS = 10  # steps over which that is taken: the first few may gain nothing in other views

_A = TypeVar("_A")
_B = TypeVar("_B")


@dataclass(frozen=True)
class ColorView:
    """One training view's box as a function of the members' colors."""

    map: ColorMap  # what each member weighs in each pixel
    others: Tensor  # what all but the members show, unclamped. [h,w,3]
    basis: Tensor  # weight of each band in each member's color from here. [M,B]
    original: Tensor  # the members' unclamped colors as they were. [M,3]

    def colors(self, offsets: Tensor) -> Tensor:
        """Unclamped. Offsets of the lowest bands [M,b,3] -> [M,3]"""
        return self.original + torch.einsum("mb,mbc->mc", self.basis[:, : offsets.shape[1]], offsets)

    def picture(self, colors: Tensor) -> Tensor:
        """Unclamped. [M,3] -> [h,w,3]"""
        return self.others + self.map.picture(colors.clamp_min(0.0))

    def error(self, offsets: Tensor, target: Tensor) -> float:
        """Sum of squared differences, of colors 0..1. [M,b,3], [h,w,3]"""
        image = self.picture(self.colors(offsets)).clamp(0.0, 1.0)
        return float((image - target).square().sum())


def color_view(crop: CropScene, original: Tensor, bands: int) -> ColorView:
    """Prepare a view. `original`: raw member rows [M,14+]; `bands`: how many may change, DC among them."""
    camera = crop.camera
    members = unpack(original, crop.member_shN)
    directions = torch.nn.functional.normalize(members.means - camera.position, dim=1)
    weights = basis(min(members.sh_degree, 3), directions)
    colors = (weights[..., None] * members.sh[:, : weights.shape[1]]).sum(dim=1) + 0.5
    weighed = color_map(crop.gaussians, camera, crop.box, crop.rows)
    picture = crop.original()
    if crop.cached is not None:
        live, constant = crop.cached
        picture = torch.where(live, picture, constant)
    return ColorView(
        weighed,
        picture - weighed.picture(colors.clamp_min(0.0)),
        weights[:, :bands].contiguous(),
        colors,
    )


def color_views(crops: Sequence[CropScene], original: Tensor) -> list[ColorView]:
    """All views, with all bands that are drawn."""
    bands = member_bands(original).shape[1]
    return _map_threads(lambda crop: color_view(crop, original, bands), crops)


@dataclass(frozen=True)
class MapFit:
    """The views' pixels as monomials of the region's drawn colors: a map's picture is linear in them."""

    design: Tensor  # what each pixel shows of every monomial. [P,20] float32
    others: Tensor  # what it shows of all but the members. [P,3]
    pixels: Sequence[Tensor]  # which pixels of each view these are, one view after another. [p] int64
    normal: Tensor  # products of all pixels' monomials. [20,20] float64
    held: Tensor  # the same of the members', hidden or not, as far as they count. [20,20] float64

    @one_thread()
    def solve(self, degree: int, targets: Sequence[Tensor]) -> Tensor:
        """The map of least squares. [h,w,3] each -> [K,3]

        A polynomial goes astray beyond the colors that it was fitted to, and members that no picture shows
        may have such: at all members' colors it is held to the affine map.
        """
        count, identity = MONOMIALS[degree], identity_map(degree)
        design = self.design[:, :count].contiguous()
        normal, pull = self.normal[:count, :count], torch.zeros(count, 3, dtype=torch.float64)
        if degree > 1:
            affine = (self.solve(1, targets) - identity_map(1)).double()
            normal, pull = normal + self.held[:count, :count], self.held[:count, :4] @ affine
        normal = normal + _MAP_RIDGE * (normal.diagonal() + 1e-12).diag()
        target = torch.cat([t.reshape(-1, 3)[p] for t, p in zip(targets, self.pixels, strict=True)])
        original, table = design @ identity, identity
        for _ in range(_CLAMP_ROUNDS):
            image = design @ table + self.others
            clamped = ((image >= 1.0) & (target >= 1.0)) | ((image <= 0.0) & (target <= 0.0))
            change = torch.where(clamped, image, target) - self.others - original
            right = (design.T @ change).double() + pull
            table = identity + torch.linalg.solve(normal, right).float()
        return table


@one_thread()
def fit_maps(views: Sequence[ColorView]) -> MapFit:
    """Prepare the views for maps of any degree."""
    total = sum(math.prod(view.map.size) for view in views)
    stride = max(1, -(-total // _MOST_PIXELS))

    def lay_out(view: ColorView) -> tuple[Tensor, Tensor]:
        terms = monomials(view.original.T.clamp(0.0, MOST_COLOR), 3).T
        planes: tuple[Tensor, ...] = torch.split(torch.cat([terms, terms[:, :1]], dim=1), 3, dim=1)
        shown = torch.cat([view.map.picture(plane).reshape(-1, 3) for plane in planes], dim=1)[:, :20]
        pixels = (shown[:, 0] > _COVERED).nonzero()[::stride, 0]
        return shown[pixels], pixels

    laid = _map_threads(lay_out, views)
    design, pixels = torch.cat([some for some, _ in laid]), [some for _, some in laid]
    others = torch.cat([view.others.reshape(-1, 3)[some] for view, some in zip(views, pixels, strict=True)])
    wide, members = design.double(), torch.zeros(20, 20, dtype=torch.float64)
    for view in views:
        terms = monomials(view.original.T.clamp(0.0, MOST_COLOR), 3).double()
        members += terms @ terms.T
    share = _MAP_HELD * len(design) / max(1, len(views) * len(views[0].original))
    return MapFit(design, others, pixels, wide.T @ wide, share * members)


@dataclass(frozen=True)
class Judge:
    """Views that are not solved for, and an edit in them."""

    views: Sequence[ColorView]
    targets: Sequence[Tensor]  # [h,w,3] each

    def error(self, offsets: Tensor) -> float:
        """Mean squared difference, with that of the pictures' own rounding. [M,B,3]"""
        count = max(1, sum(target.numel() for target in self.targets))
        pairs = list(zip(self.views, self.targets, strict=True))
        return ROUNDING + sum(_map_threads(lambda pair: pair[0].error(offsets, pair[1]), pairs)) / count


@dataclass(frozen=True)
class Model:
    """How much of an edit of colors is modelled."""

    degree: int  # of the map
    residual: Tensor  # of the finished edit: b of 0, 1 or 4 bands. [M,b,3]
    error: float  # mean square, of the finished edit in views not solved for: what is finer is not chased
    unedited: float  # the same of the original
    tried: Sequence[tuple[str, float]]  # what was tried, and its error on views not solved for, dB

    @property
    def bands(self) -> int:
        """How many bands the residual has."""
        return self.residual.shape[1]

    @property
    def error_share(self) -> float:
        """Share of the change that the finished edit misses, mean square."""
        return self.error / self.unedited

    def figures(self) -> dict[str, Any]:
        """As report.json has it."""
        tried = {name: round(error, 2) for name, error in self.tried}
        return {"degree": self.degree, "sh_functions": self.bands, "tried_psnr": tried}

    @property
    def line(self) -> str:
        """What was chosen and over what, for the log."""
        residual = (
            f"and a residual of {self.bands} SH function{'s' * (self.bands > 1)}" if self.bands else "alone"
        )
        over = ", ".join(f"{name} {error:.1f}" for name, error in self.tried)
        return f"a map of color of degree {self.degree} {residual}, the least within a twentieth; dB: {over}"


@dataclass(frozen=True)
class _Pull:
    """What the views say at some residual."""

    descent: Tensor  # against the gradient of half the error. [M,b,3]
    error: float  # squared, with what holds the residual
    # of each view, members' channels and pixels' that a clamp lets through. [M,3], [h,w,3] bool
    clamps: Sequence[tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class Solver:
    """All training views of a run."""

    views: Sequence[ColorView]  # see `ColorView`
    sh: Tensor  # the members' own. [M,B,3]
    # bound of the curvature of each member's lowest bands: Σ w·m over the pixels, m its own weight, times the
    # basis squared. [M,b,1]
    weights: Tensor
    maps: MapFit

    def map_offsets(self, degree: int, table: Tensor) -> Tensor:
        """What a map adds. [K,3] -> [M,B,3]"""
        return map_colors(self.sh, table, degree) - self.sh

    def table(self, degree: int, targets: Sequence[Tensor]) -> Tensor:
        """The map that comes nearest to these pictures. [K,3]"""
        return self.maps.solve(degree, targets)

    @one_thread()  # sums of members are added in an order that depends on the number of threads
    def residual(
        self,
        mapped: Tensor,
        start: Tensor,
        targets: Sequence[Tensor],
        steps: int,
        judge: Judge | None = None,
        floor: float = 0.0,
        tell: Callable[[], None] = lambda: None,
    ) -> tuple[Tensor, int]:
        """What the members' lowest bands need beside the map: preconditioned conjugate gradients (Polak and
        Ribière) that look at every step anew what the clamps pass; and the steps that were taken.

        Args:
            mapped: what the map adds. [M,B,3]
            start: a guess. [M,b,3]
            targets: pictures of the views
            steps: most steps
            judge: the best in its views is kept, and steps end when they gain little there, see `SETTLED`;
                None takes all
            floor: error in these views that counts as none, see `Model.error`
            tell: called after each step
        """
        base = _map_threads(lambda view: view.colors(mapped), self.views)
        curvature = self.weights[:, : start.shape[1]]
        ridge = _RIDGE * float(curvature[:, :1].mean())
        inverse = 1.0 / (curvature + ridge)
        now, pull = start, self._pull(base, start, targets, ridge)
        conditioned = along = inverse * pull.descent
        best, taken = now, 0
        looks = [math.inf] * (_LOOKS - 1) + [judge.error(add_bands(mapped, now)) if judge else math.inf]
        while taken < steps:
            length = _inner(pull.descent, along) / max(self._curvature(pull, along, ridge), 1e-30)
            for share in _SHARES:
                ahead = now + share * length * along
                next_pull = self._pull(base, ahead, targets, ridge)
                if next_pull.error < pull.error:
                    break
            else:
                if along is conditioned:
                    break
                along = conditioned  # the direction was of other clamps: begin again
                continue
            last, power = conditioned, _inner(pull.descent, conditioned)
            now, pull, taken = ahead, next_pull, taken + 1
            if judge is not None:
                error = judge.error(add_bands(mapped, now))
                best = now if error < min(looks) else best
                looks.append(error)
                if looks[-1 - _LOOKS] - error <= _LOOKS * SETTLED * max(error, floor):
                    break
            conditioned = inverse * pull.descent
            turn = (_inner(pull.descent, conditioned) - _inner(pull.descent, last)) / power
            along = conditioned + max(0.0, turn) * along
            tell()
        return (now if judge is None else best), taken

    def _pull(
        self, base: Sequence[Tensor], residual: Tensor, targets: Sequence[Tensor], ridge: float
    ) -> _Pull:
        """See `_Pull`. A clamp passes what would bring its value back into the range."""

        def look(index: int) -> tuple[Tensor, Tensor, Tensor, float]:
            view, target = self.views[index], targets[index]
            colors = base[index] + torch.einsum("mb,mbc->mc", view.basis[:, : residual.shape[1]], residual)
            image = view.picture(colors)
            squared = float((target - image.clamp(0.0, 1.0)).double().square().sum())
            counts = ~(((image <= 0.0) & (target <= 0.0)) | ((image >= 1.0) & (target >= 1.0)))
            pull = view.map.gradient((target - image) * counts)
            drawn = (colors > 0.0) | (pull > 0.0)
            return drawn, counts, pull * drawn, squared

        seen = _map_threads(look, range(len(self.views)))
        descent = -ridge * residual
        for view, (_, _, pull, _) in zip(self.views, seen, strict=True):
            descent += view.basis[:, : residual.shape[1], None] * pull[:, None]
        error = sum(squared for *_, squared in seen) + ridge * _inner(residual, residual)
        return _Pull(descent, error, [(drawn, counts) for drawn, counts, _, _ in seen])

    def _curvature(self, pull: _Pull, along: Tensor, ridge: float) -> float:
        """Of half the squared error in a direction, where the clamps stay as they are. [M,b,3]"""

        def look(index: int) -> float:
            view, (drawn, counts) = self.views[index], pull.clamps[index]
            colors = torch.einsum("mb,mbc->mc", view.basis[:, : along.shape[1]], along) * drawn
            return float((view.map.picture(colors) * counts).double().square().sum())

        return sum(_map_threads(look, range(len(self.views)))) + ridge * _inner(along, along)

    def left(self, offsets: Tensor, finished: Sequence[Tensor]) -> float:
        """Mean absolute difference from the finished edit. [M,B,3]"""

        def look(pair: tuple[ColorView, Tensor]) -> float:
            view, target = pair
            return float(l1(view.picture(view.colors(offsets)).clamp(0.0, 1.0), target))

        found = _map_threads(look, list(zip(self.views, finished, strict=True)))
        return sum(found) / len(found)


def make_solver(views: Sequence[ColorView], original: Tensor) -> Solver:
    """The views, prepared to be solved for. `original`: raw member rows [M,14+]"""
    ones = torch.ones(len(original), 3)

    def weigh(view: ColorView) -> Tensor:
        return view.basis[:, :4].square() * view.map.gradient(view.map.picture(ones))[:, :1]

    weights = torch.stack(_map_threads(weigh, views)).sum(dim=0)[..., None]
    return Solver(views, member_bands(original), weights, fit_maps(views))


def choose_model(
    solver: Solver,
    judge: Judge,
    targets: Sequence[Tensor],
    steps: int,
    most_bands: int,
) -> Model:
    """The smallest model of which a larger one would take away less than a twentieth of the error.

    Args:
        solver: the views
        judge: views that are not solved for
        targets: the finished edit in the solver's views
        steps: most steps of conjugate gradients for a residual
        most_bands: that a residual may have: 1 or 4
    """
    tried: list[tuple[str, float]] = []
    mapped, errors = {}, {}
    for degree in MONOMIALS:
        mapped[degree] = solver.map_offsets(degree, solver.table(degree, targets))
        errors[degree] = judge.error(mapped[degree])
        tried.append((f"map of degree {degree}", errors[degree]))
    degree = min(d for d in errors if MORE_PAYS * errors[d] <= min(errors.values()))
    least = errors[degree]
    residual = least_residual = torch.zeros(len(solver.sh), 0, 3)
    for more in (1, 4)[: 1 + (most_bands > 1 and solver.sh.shape[1] > 1)]:
        wider = torch.cat([residual, torch.zeros(len(residual), more - residual.shape[1], 3)], dim=1)
        residual, _ = solver.residual(mapped[degree], wider, targets, steps, judge)
        error = judge.error(add_bands(mapped[degree], residual))
        tried.append((f"with a residual of {more}", error))
        if error < MORE_PAYS * least:
            least_residual, least = residual, error
    unedited = judge.error(torch.zeros_like(solver.sh))
    decided = [(name, decibels(error)) for name, error in tried]
    return Model(degree, least_residual, least, unedited, decided)


def _inner(a: Tensor, b: Tensor) -> float:
    return float((a * b).double().sum())


def add_bands(offsets: Tensor, residual: Tensor) -> Tensor:
    """Offsets with a residual of their lowest bands added. [M,B,3], [M,b,3] -> [M,B,3]"""
    total = offsets.clone()
    total[:, : residual.shape[1]] += residual
    return total


def iterations(steps: int) -> int:
    """Most steps of conjugate gradients for `--steps` of one view each."""
    return max(1, round(steps / STEPS_OF_OTHERS))


def solve(
    original: Tensor,
    solver: Solver,
    model: Model,
    stages: Sequence[TargetStage],
    judges: Sequence[Judge],
    state: PgsState,
    on_step: OnStep,
    steps: int,
) -> Iterator[ParameterSnapshot]:
    """Solve for the stages in turn and yield each one's end, with its map.

    Args:
        original: raw member rows, packed. [M,C]
        solver: the views
        model: how much is modelled
        stages: strengths ascending
        judges: of each stage, views that say when it is done
        state: where to go on from, changed in place; a step is a stage
        on_step: progress; here, and only here, the state is whole and may be saved
        steps: most steps of conjugate gradients of a stage

    Raises:
        FloatingPointError: the loss or where it leads is not finite; the state is that of the stage before.
    """
    finished, last = stages[-1].targets, None
    for index in range(state.stage, len(stages)):
        targets = stages[index].targets
        table = solver.table(model.degree, targets)
        mapped = solver.map_offsets(model.degree, table)
        offsets = mapped
        if model.bands:
            start, before = torch.zeros_like(model.residual), 0.0
            if index:
                before = stages[index - 1].strength
                if last is None:
                    earlier = solver.table(model.degree, stages[index - 1].targets)
                    last = solver.map_offsets(model.degree, earlier)
                start = (member_bands(state.moved.detach()) - last)[:, : model.bands]
            share = (stages[index].strength - before) / (stages[-1].strength - before)
            start = torch.lerp(start, model.residual, share)
            told = partial(on_step, state.step, state.running)
            residual, taken = solver.residual(mapped, start, targets, steps, judges[index], model.error, told)
            state.means.add({STEPS: taken})
            offsets = add_bands(mapped, residual)
        last = mapped
        left = solver.left(offsets, finished)
        if not math.isfinite(left) or not bool(offsets.isfinite().all()):
            raise FloatingPointError(f"the loss is {left} at step {state.step}")
        state.previous.copy_(state.moved.detach())
        with torch.no_grad():
            state.moved.copy_(band_offsets(offsets, original.shape[1]))
        state.average.copy_(state.moved.detach())
        state.running = left
        state.means.add({"l2": Judge(solver.views, targets).error(offsets), "left": left})
        state.step, state.recorded = state.step + 1, state.recorded + 1
        state.stage, state.local = index + 1, 0
        yield ParameterSnapshot(state.step, index, True, state.average.clone(), state.means.read(), table)
        on_step(state.step, state.running)


def color_columns(channels: int, bands: int) -> Tensor:
    """Where DC and the lowest bands are in a packed row. [3·B] int64"""
    slices = attribute_slices(channels)
    dc = torch.arange(channels)[slices["sh0"]]
    higher = torch.arange(channels)[slices["shN"]][: 3 * (bands - 1)] if bands > 1 else dc[:0]
    return torch.cat([dc, higher])


def _map_threads(work: Callable[[_A], _B], items: Sequence[_A]) -> list[_B]:
    """`work` of every item, on as many threads as the rasterizer has; the same bits on any number."""
    if threads() == 1 or len(items) == 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads()) as pool:
        return list(pool.map(work, items))
