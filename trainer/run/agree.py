"""Multi-view consistent editing with a generative model.

A model that paints every view on its own decides open details (which mask, which stripes) again in each view,
and no scene can show contradicting views. Two strategies make the views agree:

- A model that takes reference images paints one view first (the anchor), then one from every other side, then
  all others. Each gets two references: the render of the scene with the members' colors fitted to the anchors
  so far, and the first anchor itself.
- A model that takes a single image paints the views in a sweep: each starts from a render of the scene with
  the members' colors fitted to the views so far.
- A served model that takes a single image and no starting picture paints each view by itself.

Consensus rounds follow if the model can start from a picture. Colors are fitted to all views
(`robust_colors`), and each view is painted again starting from their render, conditioned on its own original.
The start determines the content; the remaining denoising is free.

A model shifts and scales its outputs slightly. `register` reverts that. An output that moved farther is
painted again with another seed, and left out if that moved too far as well. So is a view that the model
refuses.

RUN/views/painted/anchor/VIEW.png   the first one is the anchor; if the user paints over it, all views follow
                                    it when the run is started again
RUN/views/painted/reference|sweep|round_1/VIEW.png   the other views; the consensus rounds

Measured gains: docs/lab/experiments.md, Views that agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate, max_pool2d

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import attribute_slices, pack
from progdf.io.images import read_picture
from progdf.io.picture_camera import find_picture_camera
from progdf.scene.bounds import scene_sphere
from progdf.sh import C0
from progdf.system.equality import equal_fields
from trainer.editors import make_editor
from trainer.editors.base import ImageEditor
from trainer.editors.cache import PictureCache, Recipe, digest
from trainer.editors.call_pool import CallPool, StoppableEditor
from trainer.editors.painter import FramePainter, PaintRequest, RefusedError
from trainer.editors.style import cross_fade
from trainer.options import EditKind, TrainOptions
from trainer.report.agreement import ViewChange, fine_energy, fit_colors, robust_colors, view_change
from trainer.store.progress import Advance, RunLog
from trainer.store.run_folder import RunFolder
from trainer.views.register import register
from trainer.views.setup import TrainingSetup, render_thumbnails
from trainer.views.view import (
    View,
    fit_size,
    frame_sphere,
    make_view,
    region_sphere,
    render_view,
    with_near_plane,
)

ANCHOR = "anchor"
"""Folder of the anchor pictures."""

_FRAME_FILL = 0.8  # share of the picture that the region fills when sides are compared

SIDE = math.radians(60)
"""Angle around the region, in radians, beyond which a view shows another side and gets its own anchor."""

CONSENSUS = 0.4
"""Denoising strength away from the render of the fit in consensus rounds, 0 to 1; 0.8 does not converge."""

SWEEP = 0.6
"""Denoising strength away from the render of the fit in a sweep, 0 to 1."""

SOFTNESS = 0.25
"""Share of the denoising over which the render's influence fades out; the remainder is free."""

MIN_DEGREE_STEP = 0.05
"""Smallest step between two prompts of --degrees, as a share of the visible change."""

MAX_MOVED = 0.05
"""Maximum shift (share of the longer side) or zoom at which a painted picture is aligned with its view."""


@dataclass(frozen=True)
class Painted:
    """Result of painting a view."""

    __eq__ = equal_fields

    picture: Tensor | None  # frame, aligned with its original; None if it cannot be used. [h,w,3]
    moved: float = 0.0  # motion against the original, see `Registration`
    refusal: str = ""  # reason why the model refuses the view; "" if it does not


@dataclass(frozen=True)
class PaintCache:
    """Cache of painted views, so that a resumed or repeated run paints nothing twice.

    The sidecar file of a picture holds the digests of all its inputs.
    """

    painter: FramePainter
    recipe: Recipe  # inputs of a picture besides those of its `PaintRequest`
    kept: PictureCache
    seed: int

    def crop(self, view: View, picture: Tensor) -> Tensor:
        """Return the part of a view's picture inside its frame, at the frame's size. [H,W,C] -> [h,w,C]"""
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
        prompt: str = "",
    ) -> Painted:
        """Paint a view, a second time if the picture moved too far to be aligned or the model refuses it.

        Args:
            view: the view to paint
            place: folder of the picture
            references, source, strength, softness, prompt: see `PaintRequest`
        """
        references = references[: self.painter.references]
        original = self.painter.original(view)
        mask = self.crop(view, view.mask[..., None])[..., 0]
        beside = beside_region(mask)
        result = Painted(None)
        for seed in (self.seed, self.seed + 1):
            recipe = {
                **self.recipe,
                "references": " ".join(map(digest, references)),
                "away_from": None if source is None else digest(source),
                "strength": strength,
                "softness": softness,
                "seed": seed,
            }
            if prompt:
                recipe["prompt"] = prompt

            def paint(picture: Tensor, seed: int = seed) -> Tensor:
                return self.painter.paint(
                    PaintRequest(picture, references, mask, strength, softness, source, seed, prompt)
                )

            folder_name = place if seed == self.seed else f"{place}/again"
            try:
                picture = self.kept.picture(view.camera.name, original, recipe, paint, folder_name)
            except RefusedError as error:
                result = Painted(None, refusal=str(error))
                continue
            registration = register(original, picture, beside)
            if registration.size <= MAX_MOVED:
                return Painted(registration.lay(picture), registration.size)
            result = Painted(None, registration.size)
        return result


def beside_region(mask: Tensor) -> Tensor:
    """Return the pixels at some distance from a region, as paint extends over its edge. [H,W] -> bool"""
    reach = 2 * (max(mask.shape) // 128) + 3
    return max_pool2d(mask[None, None], reach, 1, reach // 2)[0, 0] < 0.01


@dataclass(frozen=True)
class Fit:
    """Changes of the members' colors that agree best with all views."""

    __eq__ = equal_fields

    setup: TrainingSetup
    colors: Tensor  # change of each member's color, sRGB. [M,3]

    def render(self, camera: Camera) -> Tensor:
        """Return a render of the scene with these changes. [H,W,3]"""
        scene = self.setup.scene
        members = self.setup.region.members
        rows = pack(scene[members], with_shN=scene.sh_degree > 0)
        rows[:, attribute_slices(rows.shape[1])["sh0"]] += self.colors / C0
        edited = scene.replace_rows(members, rows)
        return render_view(edited, camera, self.setup.background).clamp(0.0, 1.0)


@dataclass(frozen=True)
class AgreedEditor:
    """Editor whose views agree. Further strengths are painted on demand."""

    easel: PaintCache
    pictures: Mapping[str, Tensor]  # view's name → the finished edit. [H,W,3]
    fit: Fit
    stages: tuple[float, ...]
    kind: EditKind
    figures: Mapping[str, object]  # for report.json
    is_confined: bool = False
    prompts: Mapping[float, str] = field(default_factory=dict)  # strength → prompt of a weaker edit

    @property
    def keeps_running(self) -> bool:
        """See `StoppableEditor.keeps_running`."""
        painter: object = self.easel.painter
        return isinstance(painter, StoppableEditor) and painter.keeps_running

    def stop(self) -> None:
        """See `StoppableEditor.stop`."""
        painter: object = self.easel.painter
        if isinstance(painter, StoppableEditor):
            painter.stop()

    def edit(self, view: View, strength: float) -> Tensor:
        """Return the view edited at a strength, see `ImageEditor.edit`."""
        if strength == 0.0:
            return view.image
        finished = self.pictures[view.camera.name]
        if strength == 1.0:
            return finished
        painter = self.easel.painter
        if not painter.has_strength and strength not in self.prompts:
            return cross_fade(view.image, finished, strength)
        fit = self.fit.render(painter.frame(view)[1])
        if not painter.has_start:
            return self._repaint(view, strength, fit)
        # source and freedom both scale with the strength, so that strength 1 equals the last round's picture
        source = torch.lerp(painter.original(view), fit, strength)
        freedom = CONSENSUS * strength
        painted = self.easel.paint(view, f"{strength:g}", [fit], source, freedom, SOFTNESS).picture
        if painted is None:
            return cross_fade(view.image, finished, strength)
        return painter.paste(view, painted)

    def _repaint(self, view: View, strength: float, fit: Tensor) -> Tensor:
        """Return the view painted at a strength by a model that cannot start from a picture.

        Args:
            view: the view
            strength: 0 to 1
            fit: render of the finished edit in the view's frame. [h,w,3]
        """
        painter = self.easel.painter
        reference = torch.lerp(painter.original(view), fit, strength)
        prompt = self.prompts.get(strength, "")
        heeded = 1.0 if prompt else strength
        painted = self.easel.paint(view, f"{strength:g}", [reference], strength=heeded, prompt=prompt).picture
        if painted is None:
            return cross_fade(view.image, self.pictures[view.camera.name], strength)
        return painter.paste(view, painted)


def painting_order(setup: TrainingSetup, side: float = SIDE) -> tuple[list[View], int]:
    """Return all views in painting order, and the number of anchors, which come first.

    The first anchor shows most of the region and most detail, as the front of a figure does. Each next anchor
    is the training view farthest from all anchors so far, until every training view is within `side` of one,
    in radians. The other views follow, nearest to an anchor first.
    """
    views = setup.views
    train = len(setup.train)
    center = scene_sphere(setup.scene[setup.region.members])[0]
    eyes = torch.stack([view.camera.position for view in views])
    toward = torch.nn.functional.normalize((eyes - center).double(), dim=1)
    angles = (toward @ toward.T).clamp(-1.0, 1.0).acos()
    anchors = [max(range(train), key=lambda i: _visible_detail(setup, views[i].camera))]
    nearest = angles[:, anchors].amin(dim=1)
    while float(nearest[:train].max()) > side:
        anchors.append(int(nearest[:train].argmax()))
        nearest = angles[:, anchors].amin(dim=1)
    others = sorted(set(range(len(views))) - set(anchors), key=lambda i: float(nearest[i]))
    return [views[i] for i in (*anchors, *others)], len(anchors)


def _visible_detail(setup: TrainingSetup, camera: Camera) -> float:
    """Return a score of the visible area and detail of the region from a camera, at equal framing.

    Faces score higher than backs.
    """
    sphere = region_sphere(setup.scene, setup.region)
    framed = frame_sphere(camera, *sphere, _FRAME_FILL, -camera.viewmat[1, :3])
    view = make_view(setup.scene, setup.region, framed, setup.background)
    image = view.image
    slope = (image[1:] - image[:-1]).abs().sum() + (image[:, 1:] - image[:, :-1]).abs().sum()
    return float(slope * view.mask.sum().sqrt())


class _PaintingLoop:
    """Loop that paints the views and holds their pictures so far.

    Args:
        easel: paints and caches the views
        setup: scene, region and views
        advance: reports progress, in pictures
        approved: a view and its approved picture, the anchor [H,W,3]; None: the first painted view is the
            anchor
        anchored: called with the first painted view, if it is the anchor
    """

    def __init__(
        self,
        easel: PaintCache,
        setup: TrainingSetup,
        advance: Advance,
        approved: tuple[View, Tensor] | None,
        anchored: Callable[[View], None],
    ) -> None:
        self._easel = easel
        self._setup = setup
        self._advance = advance
        self._anchored = anchored
        self._approved = [] if approved is None else [self._change(*approved)]
        self._first = [] if approved is None else [easel.crop(*approved)]  # the anchor, as a reference
        self.pictures: dict[str, Tensor] = {}
        self.unusable: dict[str, Painted] = {}  # last results that cannot be used, by view
        self._calls = 0

    def paint(self, view: View, place: str, **how: Any) -> None:
        """Paint a view. If the result cannot be used, the previous picture stays."""
        self._take(view, place, self._easel.paint(view, place, **how))

    def _take(self, view: View, place: str, painted: Painted) -> None:
        """Keep the picture of a view if it can be used."""
        self._calls += 1
        self._advance(self._calls, place)
        name = view.camera.name
        if painted.picture is None:
            self.unusable[name] = painted
            return
        self.pictures[name] = self._easel.painter.paste(view, painted.picture)
        if not self._first:
            self._first = [painted.picture]
            self._anchored(view)

    def paint_alone(self, views: Sequence[View]) -> None:
        """Paint each view by itself, several at the same time."""
        self._paint_together(views, ANCHOR, lambda view: self._easel.paint(view, ANCHOR))

    def follow(self, views: Sequence[View], anchors: int) -> None:
        """Paint each view with two references: the render of the fit to the anchors so far, and the first
        anchor."""
        members = len(self._setup.region.members)
        seen = [*self._approved]
        fit = Fit(self._setup, fit_colors(seen, members)) if seen else None
        for i, view in enumerate(views):
            if i >= anchors and fit is not None:
                self._follow_fit(views[i:], fit)
                return
            place = ANCHOR if i < anchors else "reference"
            name = view.camera.name
            references = [self._render(fit, view), *self._first] if fit is not None else []
            # in a thread, so that an interruption keeps the picture
            self._paint_together(
                [view], place, partial(self._easel.paint, place=place, references=references)
            )
            if name in self.pictures:
                seen.append(self._change(view, self.pictures[name]))
                fit = Fit(self._setup, fit_colors(seen, members))

    def _follow_fit(self, views: Sequence[View], fit: Fit) -> None:
        """Paint views with the render of a fit and the first anchor as references."""
        first = [*self._first]

        def paint(view: View) -> Painted:
            return self._easel.paint(view, "reference", [self._render(fit, view), *first])

        self._paint_together(views, "reference", paint)

    def _paint_together(self, views: Sequence[View], place: str, paint: Callable[[View], Painted]) -> None:
        """Paint views that do not depend on each other, as many at the same time as the painter allows."""
        painter = self._easel.painter
        with CallPool(painter.workers, painter) as pool:
            for view, painted in zip(views, pool.map(paint, views), strict=True):
                self._take(view, place, painted)

    def sweep(self, views: Sequence[View]) -> None:
        """Paint each view starting from the render of the fit to the training views so far."""
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
        """Paint all views again, starting from the render of their common fit."""
        fit = self.fit()
        for view in views:
            render = self._render(fit, view)
            self.paint(view, place, references=[render], source=render, strength=CONSENSUS, softness=SOFTNESS)

    def fit(self) -> Fit:
        """Fit the colors that agree best with the pictures of the training views."""
        return Fit(self._setup, robust_colors(self.changes(), len(self._setup.region.members)))

    def fine_energy(self) -> float:
        """Return the mean high-frequency energy per view of the training views' changes so far."""
        energies = [fine_energy(one.change) for one in self.changes()]
        return sum(energies) / len(energies)

    def changes(self) -> list[ViewChange]:
        """Return the changes in the training views' pictures so far, and in the approved one."""
        pictures = self.pictures
        train = [view for view in self._setup.train if view.camera.name in pictures]
        return [*self._approved, *(self._change(view, pictures[view.camera.name]) for view in train)]

    def _change(self, view: View, picture: Tensor) -> ViewChange:
        return view_change(self._setup, view, view.confine(picture), shrink=1)

    def _render(self, fit: Fit, view: View) -> Tensor:
        """Return a render of a fit in the frame of a view."""
        return fit.render(self._easel.painter.frame(view)[1])


def agree_views(
    easel: PaintCache,
    setup: TrainingSetup,
    editor: ImageEditor,
    log: RunLog,
    approved: tuple[View, Tensor] | None = None,
) -> AgreedEditor:
    """Paint all views so that they agree; see the module docstring.

    Args:
        easel: paints and caches the views
        setup: scene, region and views
        editor: defines the strengths and the kind of edit
        log: log of the run
        approved: a view and its approved picture, the anchor [H,W,3]; None: the first painted view is the
            anchor

    Raises:
        ProgdfError: no painted picture can be aligned with its view.
    """
    painter = easel.painter
    follows = painter.references > 0
    views, anchors = painting_order(setup, SIDE if follows else math.pi)
    rounds = 0
    if painter.has_start:
        rounds = 1 if follows else 2
    calls = len(views) * (1 + rounds)
    log.say(f"{calls} pictures to paint: {_plan(painter, len(views), anchors, rounds)}")

    def name_anchor(view: View) -> None:
        """Log the file of the anchor once it exists."""
        if easel.kept.folder is None or not (follows or painter.has_start):
            return
        path = easel.kept.folder / ANCHOR / f"{view.camera.name}.png"
        if path.is_file():
            log.say(f"all views follow {path}; to change the edit, paint over that picture and start again")

    with log.steps("edit", calls) as advance:
        loop = _PaintingLoop(easel, setup, advance, approved, name_anchor)
        if follows:
            loop.follow(views, anchors)
        elif painter.has_start:
            loop.sweep(views)
        else:
            loop.paint_alone(views)
        if not any(view.camera.name in loop.pictures for view in setup.train):
            refusals = [painted.refusal for painted in loop.unusable.values() if painted.refusal]
            if refusals:
                raise ProgdfError(f"no picture can be used: {refusals[0]}; change the instruction")
            raise ProgdfError(
                f"the model shifts or scales every picture by more than {MAX_MOVED:.0%}; use another --model"
            )
        before = loop.fine_energy()
        for number in range(rounds):
            loop.consent(views, f"round_{number + 1}")
    fit = loop.fit()
    left_out = {
        view.camera.name: loop.unusable[view.camera.name]
        for view in views
        if view.camera.name not in loop.pictures
    }
    for name, painted in left_out.items():
        reason = painted.refusal or f"every painted picture is shifted or scaled by {painted.moved:.0%}"
        log.say(f"{name}: {reason}; the fit replaces it")
    pictures = loop.pictures | {
        view.camera.name: fit.render(view.camera) for view in views if view.camera.name in left_out
    }
    figures = {
        "left_out": {name: painted.refusal or round(painted.moved, 3) for name, painted in left_out.items()},
        "contrast": round(loop.fine_energy() / max(before, 1e-9), 3),
    }
    anchor = next(view for view in views if view.camera.name in loop.pictures)
    prompts = measure_degrees(easel, anchor, pictures[anchor.camera.name], log)
    stages = (*prompts, 1.0) if prompts else editor.stages
    return AgreedEditor(easel, pictures, fit, stages, editor.kind, figures, prompts=prompts)


def measure_degrees(easel: PaintCache, view: View, finished: Tensor, log: RunLog) -> dict[float, str]:
    """Return the prompts of the painter's weaker edits by strength, ascending.

    The strength is the visible change of the region in one view, as a share of that of the finished edit. A
    prompt is left out if its picture is like the original, the finished edit or that of another prompt.

    Args:
        easel: paints and caches the views
        view: the view to measure
        finished: its finished edit. [H,W,3]
        log: log of the run
    """
    painter = easel.painter
    if not painter.degrees:
        return {}
    whole = float((view.confine(finished) - view.image).abs().mean())
    shares: dict[str, float] = {}
    with CallPool(painter.workers, painter) as pool:

        def paint(prompt: str) -> Painted:
            return easel.paint(view, f"degree_{painter.degrees.index(prompt) + 1}", prompt=prompt)

        for prompt, painted in zip(painter.degrees, pool.map(paint, painter.degrees), strict=True):
            if painted.picture is not None:
                change = view.confine(painter.paste(view, painted.picture)) - view.image
                shares[prompt] = round(float(change.abs().mean()) / max(whole, 1e-9), 3)
    prompts: dict[float, str] = {}
    for prompt, share in sorted(shares.items(), key=lambda item: item[1]):
        previous = max(prompts, default=0.0)
        if previous + MIN_DEGREE_STEP <= share <= 1.0 - MIN_DEGREE_STEP:
            prompts[share] = prompt
    listed = ", ".join(f"“{prompt}” {share:g}" for prompt, share in shares.items())
    strengths = (0.0, *prompts, 1.0)
    steps = [b - a for a, b in pairwise(strengths)]
    log.say(
        f"strengths by prompts, as the pictures of {view.camera.name} show them: {listed or 'none'}; "
        f"{len(prompts)} of {len(painter.degrees)} used, largest step {max(steps):.2f} of the change"
    )
    return prompts


def _plan(painter: FramePainter, views: int, anchors: int, rounds: int) -> str:
    """Return a description of the order of painting, for the log."""
    if painter.references:
        followers = views - anchors
        order = f"{anchors} anchors, {followers} view{'s that follow' if followers != 1 else ' that follows'}"
    elif painter.has_start:
        order = "one view after another"
    else:
        order = "each view by itself, as the model takes no references"
    repeats = {0: "", 1: ", then all once more to make them agree"}
    return order + repeats.get(rounds, ", then all twice more to make them agree")


def make_run_editor(
    options: TrainOptions, setup: TrainingSetup, folder: RunFolder, log: RunLog
) -> tuple[ImageEditor, Mapping[str, object]]:
    """Return the run's editor, and figures for report.json.

    A generative editor is wrapped so that its views agree.
    """
    settings = replace(options.editor, cache=folder.paintings)
    glances = partial(render_thumbnails, options.views, setup.scene, setup.region)
    editor = make_editor(
        settings, setup.scene, setup.region, setup.views, glances, setup.seen, log.say, log.waiting
    )
    if not isinstance(editor, FramePainter):
        return editor, {}
    painter = editor
    log.say(painter.note)
    easel = PaintCache(painter, painter.recipe, painter.kept, settings.seed)
    approved = None
    if settings.anchor is not None:
        found = find_picture_camera(settings.anchor, origin=setup.scene.origin)
        (camera,) = with_near_plane([fit_size(found, painter.size)], setup.scene)
        view = make_view(setup.scene, setup.region, camera, setup.background)
        if not bool((view.mask > 0.0).any()):
            raise ProgdfError(f"{settings.anchor} does not show the region; take it from another position")
        approved = view, read_picture(settings.anchor, size=(camera.width, camera.height))
    agreed = agree_views(easel, setup, editor, log, approved)
    return agreed, agreed.figures
