"""Views that agree: what a sentence leaves open is decided once, in one picture, and all views follow it.

A model that paints every view by itself decides anew in each (which mask, which stripes), and what the views
show differently no scene can show. So one view is painted first, the anchor, then one from every other side,
then all others, each with two references: what the anchors make of the scene as it is seen from there (the
members' colors fitted to them), and the first anchor itself. A model that takes one picture alone sweeps:
each next view starts from what the views so far make of the scene. Then comes consensus: colors are fitted to
all views (`robust_colors`), and each is painted again away from their render, its own original being the
condition: what it starts from decides what is painted, and the rest of the way is free.

A model's answers are shifted and scaled by a little: `register` takes that back. What is moved farther is
painted again with another seed, then left out.

RUN/views/painted/anchor/VIEW.png   the first of them decides: painted over by hand, all follow it in a run
                                    that is begun again
RUN/views/painted/reference|sweep|round_1/VIEW.png   the others; the rounds of consensus

What it brings is in docs/experiments.md, Views that agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, max_pool2d

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import attribute_slices, pack
from progdf.scene.bounds import scene_sphere
from progdf.sh import C0
from trainer.editors.base import ImageEditor
from trainer.editors.cache import KeptPictures, Recipe, digest
from trainer.editors.instruct import InstructEditor
from trainer.editors.style import cross_fade
from trainer.options import EditKind
from trainer.report.agreement import ViewChange, fine_energy, fit_colors, robust_colors, view_change
from trainer.setup import TrainingSetup
from trainer.store.progress import Advance, RunLog
from trainer.views.view import View, frame_sphere, make_view, region_sphere, render_view

ANCHOR = "anchor"
"""Folder of the pictures that decide."""

_FRONT = 0.8  # of a picture that the region fills where sides are compared

SIDE = math.radians(60)
"""Angle around the region from which on a view shows another side, which gets an anchor of its own."""

CONSENSUS = 0.4
SWEEP = 0.6
"""Strengths away from the render of the fit: at .8 views decide anew, and do not converge."""

SOFTNESS = 0.25
"""Share of the painting over which the render is let go of: a decision first, then a free finish."""

MAX_MOVED = 0.05
"""Shift, as a share of the longer side, or zoom, above which an answer is not laid over its view."""


@dataclass(frozen=True)
class Registration:
    """How an answer lies over its view: a point at `p` from the middle is found at (1 + zoom) p + shift."""

    shift: tuple[float, float] = (0.0, 0.0)  # x, y, shares of the longer side
    zoom: float = 0.0

    @property
    def size(self) -> float:
        """The largest of the three."""
        return max(abs(self.shift[0]), abs(self.shift[1]), abs(self.zoom))

    def lay(self, picture: Tensor) -> Tensor:
        """The answer, moved back; bit for bit where that is less than a quarter of a pixel. [H,W,3]"""
        longer = max(picture.shape[:2])
        if self.size * longer < 0.25:
            return picture
        planes = picture.permute(2, 0, 1)[None]
        parameters = torch.tensor([*self.shift, self.zoom], dtype=torch.float64)
        return _sample(planes, parameters, "bicubic")[0].permute(1, 2, 0).clamp(0.0, 1.0)


def register(original: Tensor, picture: Tensor, beside: Tensor) -> Registration:
    """Shift and zoom of a picture against the original, by robust Gauss-Newton from coarse to fine.

    Brightness and contrast may differ as a whole. Nothing is found where what is beside the region has no
    texture, or was painted anew.

    Args:
        original, picture: [H,W,3]
        beside: pixels that should show the same in both. [H,W] bool
    """
    levels = []
    planes = [image.permute(2, 0, 1)[None] for image in (original, picture)]
    masks = beside.float()[None, None]
    for level in range(6):
        factor = 2**level
        height, width = (side // factor for side in beside.shape)
        if level and min(height, width) < 12:
            break
        a, b, weight = (interpolate(image, (height, width), mode="area") for image in (*planes, masks))
        levels.append((a, b, (weight > 0.999).float()))
    parameters = torch.zeros(3, dtype=torch.float64)
    for a, b, weight in reversed(levels):
        for _ in range(12):
            step, _ = _step(a, b, weight, parameters)
            parameters = parameters + step
            if float(step.abs().max()) * max(a.shape[2:]) < 0.01:
                break
    a, b, weight = levels[0]
    before, after = (_step(a, b, weight, some)[1] for some in (torch.zeros_like(parameters), parameters))
    if not after < _BETTER * before:
        return Registration()
    x, y, zoom = parameters.tolist()
    return Registration((x, y), zoom)


_BETTER = 0.8  # of the misfit as it lies: noise alone makes one place a little better than another
_TEXTURE = 0.01  # standard deviation of color; what has less fits anywhere
_TUKEY = 4.685  # in standard deviations: 95 % as good as least squares where the noise is normal


def _step(a: Tensor, b: Tensor, weight: Tensor, parameters: Tensor) -> tuple[Tensor, float]:
    """One step of Gauss-Newton with Tukey's weights [3], and the robust misfit before it."""
    moved, (x, y) = _sample(b, parameters), _places(b)
    counts = (weight > 0)[0, 0]
    if int(counts.sum()) < 16 or float(a[0][:, counts].std(dim=1).max()) < _TEXTURE:
        return torch.zeros(3, dtype=torch.float64), 0.0
    gradients = [
        torch.nn.functional.pad((moved[..., 2:] - moved[..., :-2]) / 2, (1, 1)),
        torch.nn.functional.pad((moved[..., 2:, :] - moved[..., :-2, :]) / 2, (0, 0, 1, 1)),
    ]
    gx, gy = (g[0][:, counts].double() * max(a.shape[2:]) for g in gradients)
    target = a[0][:, counts].double()
    source = moved[0][:, counts].double()
    gain = target.std(dim=1, keepdim=True) / source.std(dim=1, keepdim=True).clamp_min(1e-6)
    gain = gain.clamp(0.5, 2.0)
    residual = target - (source - source.mean(1, keepdim=True)) * gain - target.mean(1, keepdim=True)
    spread = 1.4826 * float(residual.abs().median()) + 1e-3
    rho = (1 - (residual / (_TUKEY * spread)).square()).clamp_min(0.0).square()
    jacobian = gain[..., None] * torch.stack([gx, gy, x[counts] * gx + y[counts] * gy], dim=2)
    jacobian = jacobian.reshape(-1, 3)
    normal = jacobian.T @ (rho.reshape(-1, 1) * jacobian)
    slope = jacobian.T @ (rho * residual).reshape(-1)
    damping = 1e-4 * normal.diagonal().max() + 1e-9
    step = torch.linalg.solve(normal + damping * torch.eye(3, dtype=torch.float64), slope)
    return step.clamp(-0.05, 0.05), float(residual.abs().clamp_max(0.1).mean())


def _places(planes: Tensor) -> tuple[Tensor, Tensor]:
    """x and y of the pixels from the middle, shares of the longer side. [H,W] float64 each"""
    height, width = planes.shape[2:]
    longer = max(height, width)
    y = (torch.arange(height, dtype=torch.float64) + 0.5 - height / 2) / longer
    x = (torch.arange(width, dtype=torch.float64) + 0.5 - width / 2) / longer
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    return columns, rows


def _sample(planes: Tensor, parameters: Tensor, mode: str = "bilinear") -> Tensor:
    """Planes read where `Registration` says. [1,C,H,W]"""
    (x, y), (height, width) = _places(planes), planes.shape[2:]
    dx, dy, zoom = parameters.tolist()
    scale = 2 * max(height, width)
    grid = torch.stack([scale / width * ((1 + zoom) * x + dx), scale / height * ((1 + zoom) * y + dy)], dim=2)
    return grid_sample(planes, grid.float()[None], mode, padding_mode="border", align_corners=False)


@dataclass(frozen=True)
class Easel:
    """Paints views, and keeps what is painted: a run that goes on, or comes again, paints nothing twice.

    The note beside a picture holds the digests of all that it was made from.
    """

    painter: InstructEditor
    recipe: Recipe  # what a picture depends on besides what `InstructEditor.paint` is given
    kept: KeptPictures
    seed: int

    def crop(self, view: View, picture: Tensor) -> Tensor:
        """What a picture of a view shows in its frame, at the frame's size. [H,W,C] -> [h,w,C]"""
        (x0, y0, x1, y1), camera = self.painter.frame(view)
        planes = picture[y0:y1, x0:x1].permute(2, 0, 1)[None]
        size = (camera.height, camera.width)
        return interpolate(planes, size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)

    def paint(
        self,
        view: View,
        place: str,
        references: Sequence[Tensor] = (),
        source: Tensor | None = None,
        strength: float = 1.0,
        softness: float = 1.0,
    ) -> tuple[Tensor | None, float]:
        """The frame of a view as painted, laid over its original, and by how much it was moved, see
        `Registration`. [h,w,3]

        None where the answers to two seeds are moved too far to be laid over it.

        Args:
            view: what is painted
            place: folder of the picture
            references, source, strength, softness: see `InstructEditor.paint`
        """
        references, original = references[: self.painter.references], self.painter.original(view)
        beside = beside_region(self.crop(view, view.mask[..., None])[..., 0])
        moved = 0.0
        for seed in (self.seed, self.seed + 1):
            recipe = {
                **self.recipe,
                "references": " ".join(map(digest, references)),
                "away_from": None if source is None else digest(source),
                "strength": strength,
                "softness": softness,
                "seed": seed,
            }

            def paint(picture: Tensor, seed: int = seed) -> Tensor:
                return self.painter.paint(
                    picture, references, strength=strength, softness=softness, source=source, seed=seed
                )

            where = place if seed == self.seed else f"{place}/again"
            picture = self.kept.picture(view.camera.name, original, recipe, paint, where)
            registration = register(original, picture, beside)
            moved = registration.size
            if moved <= MAX_MOVED:
                return registration.lay(picture), moved
        return None, moved


def beside_region(mask: Tensor) -> Tensor:
    """The pixels away from a region by a little, as what is painted reaches over its edge. [H,W] -> bool"""
    reach = 2 * (max(mask.shape) // 128) + 3
    return max_pool2d(mask[None, None], reach, 1, reach // 2)[0, 0] < 0.01


@dataclass(frozen=True)
class Fit:
    """What all views agree on best: changes of the members' colors."""

    setup: TrainingSetup
    colors: Tensor  # [M,3]

    def render(self, camera: Camera) -> Tensor:
        """The scene with these changes. [H,W,3]"""
        scene = self.setup.scene
        members = self.setup.region.members
        rows = pack(scene[members], with_shN=scene.sh_degree > 0)
        rows[:, attribute_slices(rows.shape[1])["sh0"]] += self.colors / C0
        edited = scene.replace_rows(members, rows)
        return render_view(edited, camera, self.setup.background).clamp(0.0, 1.0)


@dataclass(frozen=True)
class AgreedEditor:
    """An editor whose views agree; its further strengths are painted when they are asked for."""

    easel: Easel
    pictures: Mapping[str, Tensor]  # view's name → the finished edit. [H,W,3]
    fit: Fit
    stages: tuple[float, ...]
    kind: EditKind
    figures: Mapping[str, object]  # as report.json has them
    is_confined: bool = False

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        if strength == 0.0:
            return view.image
        finished = self.pictures[view.camera.name]
        if strength == 1.0:
            return finished
        painter = self.easel.painter
        fit = self.fit.render(painter.frame(view)[1])
        # from the view at this degree of what all agree on, as free as that: 1 is the last round's picture
        source = torch.lerp(painter.original(view), fit, strength)
        freedom = CONSENSUS * strength
        painted, _ = self.easel.paint(view, f"{strength:g}", [fit], source, freedom, SOFTNESS)
        if painted is None:
            return cross_fade(view.image, finished, strength)
        return painter.paste(view, painted)


def painting_order(setup: TrainingSetup, side: float = SIDE) -> tuple[list[View], int]:
    """All views in the order in which they are painted, and how many of them, the first, are anchors.

    The first shows most of the region and of detail, as fronts do; then come those farthest from all before,
    until every view that is trained on is within `side` of one; then the others, nearest to an anchor first.
    """
    views, train = setup.views, len(setup.train)
    center = scene_sphere(setup.scene[setup.region.members])[0]
    eyes = torch.stack([view.camera.position for view in views])
    toward = torch.nn.functional.normalize((eyes - center).double(), dim=1)
    angles = (toward @ toward.T).clamp(-1.0, 1.0).acos()
    anchors = [max(range(train), key=lambda i: _front(setup, views[i].camera))]
    while float((nearest := angles[:, anchors].amin(dim=1))[:train].max()) > side:
        anchors.append(int(nearest[:train].argmax()))
    others = sorted(set(range(len(views))) - set(anchors), key=lambda i: float(nearest[i]))
    return [views[i] for i in (*anchors, *others)], len(anchors)


def _front(setup: TrainingSetup, camera: Camera) -> float:
    """How much is to be seen from there, of the region and of detail around it, with all equally large: faces
    have more than backs."""
    sphere = region_sphere(setup.scene, setup.region)
    framed = frame_sphere(camera, *sphere, _FRONT, -camera.viewmat[1, :3])
    view = make_view(setup.scene, setup.region, framed, setup.background)
    image = view.image
    slope = (image[1:] - image[:-1]).abs().sum() + (image[:, 1:] - image[:, :-1]).abs().sum()
    return float(slope * view.mask.sum().sqrt())


class _Loop:
    """The pictures of all views so far.

    Args:
        easel: paints
        setup: scene, region and views
        advance: progress, in pictures
        approved: a view, and its picture that decides [H,W,3]; None: the first that is painted does
    """

    def __init__(
        self, easel: Easel, setup: TrainingSetup, advance: Advance, approved: tuple[View, Tensor] | None
    ) -> None:
        self._easel = easel
        self._setup = setup
        self._advance = advance
        self._approved = [] if approved is None else [self._change(*approved)]
        self._first = [] if approved is None else [easel.crop(*approved)]  # the anchor, as a reference
        self.pictures: dict[str, Tensor] = {}
        self.moved: dict[str, float] = {}
        self._calls = 0

    def paint(self, view: View, place: str, **how: Any) -> None:
        """Paint a view; where the answer cannot be laid over it, what there was before stays."""
        picture, moved = self._easel.paint(view, place, **how)
        self._calls += 1
        self._advance(self._calls, place)
        self.moved[view.camera.name] = moved
        if picture is not None:
            self.pictures[view.camera.name] = self._easel.painter.paste(view, picture)
            self._first = self._first or [picture]

    def follow(self, views: Sequence[View], anchors: int) -> None:
        """Paint each view with two references: what the anchors so far show of it, and the first of them."""
        members = len(self._setup.region.members)
        seen = [*self._approved]
        fit = Fit(self._setup, fit_colors(seen, members)) if seen else None
        for i, view in enumerate(views):
            place = ANCHOR if i < anchors else "reference"
            name = view.camera.name
            references = [self._render(fit, view), *self._first] if fit is not None else []
            self.paint(view, place, references=references)
            if name in self.pictures and (i < anchors or fit is None):
                seen.append(self._change(view, self.pictures[name]))
                fit = Fit(self._setup, fit_colors(seen, members))

    def sweep(self, views: Sequence[View]) -> None:
        """Paint each view away from what the views so far, of those trained on, make of the scene."""
        train = {view.camera.name for view in self._setup.train}
        seen = [*self._approved]
        for view in views:
            if seen:
                fit = Fit(self._setup, fit_colors(seen, len(self._setup.region.members)))
                render = self._render(fit, view)
                self.paint(view, "sweep", source=render, strength=SWEEP, softness=SOFTNESS)
            else:
                self.paint(view, ANCHOR)
            if view.camera.name in train & self.pictures.keys():
                seen.append(self._change(view, self.pictures[view.camera.name]))

    def consent(self, views: Sequence[View], place: str) -> None:
        """Paint all views again, away from the render of what they agree on."""
        fit = self.fit()
        for view in views:
            render = self._render(fit, view)
            self.paint(view, place, references=[render], source=render, strength=CONSENSUS, softness=SOFTNESS)

    def fit(self) -> Fit:
        """The colors that the pictures of the training views agree on best."""
        return Fit(self._setup, robust_colors(self.changes(), len(self._setup.region.members)))

    def fine_energy(self) -> float:
        """Of the changes of the training views so far, a view."""
        energies = [fine_energy(one.change) for one in self.changes()]
        return sum(energies) / len(energies)

    def changes(self) -> list[ViewChange]:
        """What the pictures of the training views change so far, and the one that decides."""
        pictures = self.pictures
        train = [view for view in self._setup.train if view.camera.name in pictures]
        return [*self._approved, *(self._change(view, pictures[view.camera.name]) for view in train)]

    def _change(self, view: View, picture: Tensor) -> ViewChange:
        return view_change(self._setup, view, view.confine(picture), shrink=1)

    def _render(self, fit: Fit, view: View) -> Tensor:
        """A fit as a frame shows it."""
        return fit.render(self._easel.painter.frame(view)[1])


def agree_views(
    easel: Easel,
    setup: TrainingSetup,
    editor: ImageEditor,
    log: RunLog,
    approved: tuple[View, Tensor] | None = None,
) -> AgreedEditor:
    """Paint all views so that they agree; see the module's head.

    Args:
        easel: paints
        setup: scene, region and views
        editor: whose strengths and kind of edit these are
        log: of the run
        approved: a view, and its picture that decides [H,W,3]; None: the first that is painted does

    Raises:
        ProgdfError: no answer can be laid over its view.
    """
    follows = easel.painter.references > 0
    views, anchors = painting_order(setup, SIDE if follows else math.pi)
    rounds = 1 if follows else 2
    how = f"{anchors} first, {len(views) - anchors} after these" if follows else "each after those before"
    again = "once" if rounds == 1 else "twice"
    calls = len(views) * (1 + rounds)
    log.say(f"{calls} pictures to paint: {how}, then all {again} more, away from what they share")
    if easel.kept.folder is not None and approved is None:
        path = easel.kept.folder / ANCHOR / f"{views[0].camera.name}.png"
        log.say(f"{path} decides: paint over it and begin again, and all views follow it")
    with log.steps("edit", calls) as advance:
        loop = _Loop(easel, setup, advance, approved)
        if follows:
            loop.follow(views, anchors)
        else:
            loop.sweep(views)
        if not any(view.camera.name in loop.pictures for view in setup.train):
            raise ProgdfError(
                f"the model moves all that it paints by more than {MAX_MOVED:.0%}; use another --model"
            )
        before = loop.fine_energy()
        for number in range(rounds):
            loop.consent(views, f"round_{number + 1}")
    fit = loop.fit()
    left_out = {
        view.camera.name: round(loop.moved[view.camera.name], 3)
        for view in views
        if view.camera.name not in loop.pictures
    }
    for name, moved in left_out.items():
        log.say(f"{name} is left out: its answers are shifted or scaled by {moved:.0%}; the fit stands in")
    pictures = loop.pictures | {
        view.camera.name: fit.render(view.camera) for view in views if view.camera.name in left_out
    }
    figures = {"left_out": left_out, "contrast": round(loop.fine_energy() / max(before, 1e-9), 3)}
    return AgreedEditor(easel, pictures, fit, editor.stages, editor.kind, figures)
