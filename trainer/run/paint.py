"""Discs for paint finer than the Gaussians: decals, brushed paint, and the remainder after recoloring."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from scipy import ndimage
from torch import Tensor

from progdf.camera import Camera
from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError
from progdf.fade import linear_remap
from progdf.field.baked import interpolate_at
from progdf.field.separable import course_field, opacity_course
from progdf.gaussians import BASE_CHANNELS, Gaussians, attribute_slices, concatenate, pack
from progdf.gdf.anchors import PUSHED_SHAPE
from progdf.gdf.file import ADDED_LOGIT, Gdf, anchor_added, fingerprint
from progdf.io.images import picture_size
from progdf.metrics.image import decibels
from progdf.rasterize import alpha_weights, render
from progdf.rasterize.engines import activate, color_map
from progdf.region import Region
from progdf.sh import C0, rgb_to_sh0
from progdf.surface.find import find_surface, orbit
from progdf.system.equality import equal_fields
from progdf.terminal import group_digits
from trainer.editors.pictures import read_edit
from trainer.paint.discs import (
    BORDER_PX,
    DISC_LOGIT,
    PaintedView,
    cover_view,
    faint,
    place_discs,
    project_paint,
)
from trainer.paint.solve import ExpectedView, box_of, solve_colors, solve_shares
from trainer.store.progress import RunLog
from trainer.views.view import BACKGROUND, View, crop, make_view, render_view

RING = 15
"""Width of the ring around the paint that must stay unchanged, pixels."""

TRIAL_ANGLES_DEG = (-60, -30, 0, 30, 60)
"""Angles of the views around the paint that choose the gap, degrees."""

_GAPS_PX = (4.0, 1.0)  # tried distances between discs and the Gaussians pushed behind them
_DISC_COLOR_RMS = 0.015  # maximum RMS color error of a disc over its pixels
_SPILL_COLOR = 1 / 255  # smallest color change beside the paint that counts as caused by pushed Gaussians
_MIN_SPILL_WEIGHT_PX = 0.5  # with a larger sum of weights in such pixels, a Gaussian may change its color
_MIN_PAINT_WEIGHT_PX = 1e-3  # with a smaller weight in painted pixels, a Gaussian keeps its color
_MISSED_COLOR = 0.05  # color error from which a painted pixel counts as missed by recoloring
_ROUNDING_COLOR = 1.5 / 255  # two 8-bit images may differ by this much through rounding
_ERROR_SIGMA_PX = 2.0  # sigma of the Gaussian filter over the squared error
_BEHIND_DEG = (150.0, 180.0, 210.0)  # angles of the views that see the surface from behind
_BURIED_SHARE = 0.5  # share of a Gaussian's visible weight under the paint from which discs replace it
_GEOMETRY = ("means", "log_scales")  # attributes of the moves behind the discs
_COUNTING_ALPHA = 0.1  # opacity of discs while their overlap is counted
# position on the path from which all moved Gaussians lie behind the discs, and replaced ones fade
_CLEARED_AT = 0.25
_OPACITY_CHANNEL = 10  # column of a packed row, see `attribute_slices`


@dataclass(frozen=True)
class DiscLayout:
    """Paint converted to discs."""

    __eq__ = equal_fields

    scene: Gaussians  # the scene under the discs, at strength 1
    ended: Gaussians  # this scene with occluding Gaussians pushed behind the discs
    rows: Tensor  # indices of the Gaussians that change. [M] int64
    added: Gaussians  # the discs at strength 1
    rim: Tensor  # share of each disc that lies beside the paint, 0 to 1. [A]
    gap: float  # distance between discs and pushed Gaussians, pixels

    @property
    def end(self) -> Gaussians:
        """The scene with the paint. The discs follow the scene's own rows."""
        return concatenate([self.ended, self.added])


@dataclass(frozen=True)
class PaintGoal:
    """Paint on a scene, and the views that the painted scene has to match."""

    __eq__ = equal_fields

    scene: Gaussians  # the scene under the discs
    paints: Sequence[PaintedView]  # painted views of one object
    views: Sequence[ExpectedView]  # these views, and views rotated around the paint
    buried: Tensor  # Gaussians mostly visible where the paint is; discs replace them. [N] bool
    behind: Tensor  # each Gaussian's largest sum of weights in views from behind, pixels. [N]


def make_goal(scene: Gaussians, paints: Sequence[PaintedView], below: Gaussians | None = None) -> PaintGoal:
    """Return the goal of paint on a scene.

    Args:
        scene: the scene under the discs
        paints: painted views of one object
        below: see `views_around_paint`
    """
    views = views_around_paint(scene, paints, TRIAL_ANGLES_DEG, below=below)
    inside = torch.zeros(len(scene))
    beside = torch.zeros(len(scene))
    for view in views:
        weights = alpha_weights(scene, view.camera, view.covered)
        inside += weights[:, 0]
        beside += weights[:, 2] - weights[:, 0]
    behind = torch.zeros(len(scene))
    for paint in paints:
        pivot = paint.surface.pivot(paint.mask.numpy())
        for angle in _BEHIND_DEG:
            camera = orbit(paint.camera, pivot, angle)
            weights = alpha_weights(scene, camera, torch.zeros_like(paint.mask))
            behind = torch.maximum(behind, weights[:, 2])
    seen = inside + beside + len(views) * behind
    return PaintGoal(scene, paints, views, inside > _BURIED_SHARE * seen, behind)


def lay_discs(goal: PaintGoal, gap: float) -> DiscLayout:
    """Convert painted pixels to discs. Each picture adds discs only where earlier pictures added none.

    Args:
        goal: the paint
        gap: see `place_discs`
    """
    scene = goal.scene
    paints = goal.paints
    cleared = scene
    added = scene[:0]
    rim = torch.zeros(0)
    changed = torch.zeros(len(scene), dtype=torch.bool)
    for paint in paints:
        unseen_paint = paint
        if len(added):
            colors = torch.cat([torch.zeros(len(scene), 3), torch.ones(len(added), 3)])
            with_discs = concatenate([cleared, added])
            disc_coverage = render(with_discs, paint.camera, (0.0, 0.0, 0.0), colors=colors).image[..., 0]
            # discs extend beyond the paint by this margin
            near_discs = ndimage.binary_dilation((disc_coverage > 0.5).numpy(), iterations=BORDER_PX)
            unseen_paint = replace(paint, drawn=paint.drawn * ~torch.from_numpy(near_discs)[..., None])
        discs = place_discs(scene, unseen_paint, _DISC_COLOR_RMS, gap, cleared)
        cleared = discs.scene
        added = concatenate([added, discs.added])
        rim = torch.cat([rim, discs.rim])
        changed[discs.moved] = True
    for paint in paints:
        box = box_of(paint.mask, paint.camera)
        before, after = (
            render(state, paint.camera, BACKGROUND, crop=box).image for state in (scene, cleared)
        )
        beside = ~ndimage.binary_dilation(paint.mask.numpy(), iterations=BORDER_PX)
        spill = torch.zeros_like(paint.mask)
        crop(spill, box)[:] = (after - before).abs().amax(dim=2) > _SPILL_COLOR
        spill_weight = alpha_weights(cleared, paint.camera, spill & torch.from_numpy(beside))[:, 0]
        changed |= spill_weight > _MIN_SPILL_WEIGHT_PX
    joined = concatenate([cleared, added])
    for view in goal.views:
        if view.degrees:  # from aside, Gaussians beside and below the discs cover them
            weights = alpha_weights(joined, view.camera, view.covered)[: len(scene), 0]
            changed |= weights > _MIN_SPILL_WEIGHT_PX
    rows = changed.nonzero()[:, 0]
    faded = changed & goal.buried
    logits = torch.where(faded, ADDED_LOGIT, cleared.logit_opacities)
    cleared = replace(cleared, logit_opacities=logits)
    ended, added = solve_colors(cleared, rows, added, goal.views, goal.behind[rows])
    return DiscLayout(scene, ended, rows, added, rim, gap)


def views_around_paint(
    scene: Gaussians,
    paints: Sequence[PaintedView],
    degrees: Sequence[float],
    around: Sequence[PaintedView] | None = None,
    below: Gaussians | None = None,
    shows_pictures: bool = True,
) -> list[ExpectedView]:
    """Return views rotated around the paint, with their expected images.

    Args:
        scene: the scene under the paint
        paints: painted views of one object
        degrees: rotation angles of each camera; 0 is the picture itself
        around: the paints whose cameras are rotated; None for all
        below: scene that is visible under the paint and the border of its discs; None for `scene`
        shows_pictures: True: the expected image at 0 degrees is the painted picture; False: it is the paint
            over `scene`, as at other angles
    """
    background = torch.tensor(BACKGROUND)
    views = []
    for paint in paints if around is None else around:
        pivot = paint.surface.pivot(paint.mask.numpy())
        for angle in degrees:
            camera = orbit(paint.camera, pivot, angle) if angle else paint.camera
            if angle or not shows_pictures:
                image = render_view(scene, camera, background).clamp(0.0, 1.0)
                under = None if below is None else render_view(below, camera, background).clamp(0.0, 1.0)
                drawn = []
                for other in paints:
                    is_own = other is paint and not angle
                    drawn.append(
                        other.drawn if is_own else project_paint(scene, other.surface, other.drawn, camera)
                    )
                expected, covered = cover_view(image, under, drawn)
            else:
                expected = paint.picture
                covered = paint.mask
            grown = ndimage.binary_dilation(covered.numpy(), iterations=RING)
            views.append(ExpectedView(camera, angle, expected, covered, torch.from_numpy(grown) & ~covered))
    return views


def mean_square_error(finished: Gaussians, looks: Sequence[ExpectedView]) -> float:
    """Return the squared color error of whole views, per pixel at and around the paint.

    Discs that float away from the paint count too, wherever they are seen.
    """
    error = pixels = 0.0
    for view in looks:
        compared = view.covered | view.around
        if not bool(compared.any()):
            continue
        image = render(finished, view.camera, BACKGROUND).image.clamp(0.0, 1.0)
        error += float((image - view.expected).square().sum())
        pixels += 3 * int(compared.sum())
    return error / max(1.0, pixels)


def choose_discs(goal: PaintGoal, log: RunLog | None) -> DiscLayout:
    """Return the discs with the gap that reproduces the paint best, in its own views and from the sides.

    Args:
        goal: the paint
        log: log of the run

    Raises:
        ProgdfError: the paint is not on an opaque surface.
    """
    candidates = list[tuple[float, DiscLayout]]()
    for gap in _GAPS_PX:
        laid = lay_discs(goal, gap)
        if not len(laid.added):
            raise ProgdfError("nothing is painted where the picture is opaque; paint on the scene")
        candidates.append((mean_square_error(laid.end, goal.views), laid))
    best = min(candidates, key=lambda one: one[0])
    if log is not None:
        for paint in goal.paints:
            log.say(f"surface under the paint: {paint.surface.describe()}")
        errors = ", ".join(f"{decibels(error):.1f} dB with {laid.gap:g} px" for error, laid in candidates)
        log.say(
            f"occluding Gaussians move {best[1].gap:g} px behind the paint; tried: {errors} "
            f"(painted view and views up to {max(TRIAL_ANGLES_DEG)}° beside it, per pixel in the paint and "
            f"{RING} px around it)"
        )
    return best[1]


@dataclass(frozen=True)
class Recolor:
    """Paint as colors of the scene's Gaussians."""

    __eq__ = equal_fields

    ended: Gaussians  # the scene at strength 1
    rows: Tensor  # indices of the Gaussians that change. [M] int64


def recolor_paint(goal: PaintGoal) -> Recolor:
    """Return the colors of the visible Gaussians under the paint that reproduce it, without discs.

    Each color lies between the Gaussian's own and the mean of its paint, so that no other hue appears.
    """
    scene = goal.scene
    weights = torch.zeros(len(scene))
    for view in goal.views:
        weights = torch.maximum(weights, alpha_weights(scene, view.camera, view.covered)[:, 0])
    rows = (weights > _MIN_SPILL_WEIGHT_PX).nonzero()[:, 0]
    paint, weights = _mean_colors(goal, rows)
    towards = (rgb_to_sh0(paint) - scene.sh0[rows]) * (weights > _MIN_PAINT_WEIGHT_PX)
    shares = solve_shares(scene, rows, C0 * towards, goal.views, goal.behind[rows])
    ended = replace(scene, sh0=scene.sh0.index_add(0, rows, shares[:, None] * towards))
    return Recolor(ended, rows)


def _mean_colors(goal: PaintGoal, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean color of the painted pixels in which each Gaussian is visible, and its weight there,
    pixels. [M,3] each"""
    scene = goal.scene
    activated = activate(scene)
    sums = torch.zeros(len(rows), 3)
    weights = torch.zeros(len(rows), 3)
    for paint in goal.paints:
        seen = color_map(activated, paint.camera, (0, 0, paint.camera.width, paint.camera.height), rows)
        sums += seen.gradient(paint.drawn[..., :3].contiguous())
        weights += seen.gradient(paint.drawn[..., 3:].expand(-1, -1, 3).contiguous())
    return sums / weights.clamp_min(_MIN_PAINT_WEIGHT_PX), weights


def recolor_gdf(recolored: Recolor, scene: Gaussians, name: str) -> Gdf:
    """Return the edit that ends in these colors. Colors, and so pictures, are linear in the strength."""
    rows = recolored.rows
    offsets = pack(recolored.ended[rows], with_shN=False) - pack(scene[rows], with_shN=False)
    field = course_field(torch.tensor([0.0, 1.0]), torch.stack([torch.zeros_like(offsets), offsets]))
    score = torch.zeros(len(scene))
    score[rows] = 1.0
    return Gdf(name, Region(name, rows, score), field, fingerprint(scene))


def paint_gdf(
    laid: DiscLayout, scene: Gaussians, paints: Sequence[PaintedView], name: str, recolored: Gdf | None
) -> Gdf:
    """Return the edit that ends in discs. Their visible change is linear in the strength.

    Args:
        laid: the discs
        scene: the original
        paints: the painted views of the discs
        name: name of the layer
        recolored: recolor below the discs, which are fitted to its full edit or to a reduced share of it;
            None if the discs lie on the original
    """
    members = torch.unique(torch.cat([laid.rows, recolored.region.members])) if recolored else laid.rows
    score = torch.zeros(len(scene)) if recolored is None else recolored.region.score.clone()
    score[laid.rows] = 1.0
    channels = BASE_CHANNELS if recolored is None else recolored.field.channels
    bands = channels > BASE_CHANNELS
    base = laid.scene
    start = faint(laid.added)
    path = _disc_path(laid, paints, bands)
    disc_knots = _linear_visibility_knots(laid, paints, path)
    knots = disc_knots
    inside = torch.searchsorted(members, laid.rows)
    recolor_end = torch.zeros(len(members), channels)
    if recolored is not None:
        knots = torch.unique(torch.cat([disc_knots, recolored.field.knots]))
        recolor_end = pack(base[members], with_shN=bands) - pack(scene[members], with_shN=bands)
    offsets = torch.zeros(len(knots), len(members) + len(start), channels)
    for k, s in enumerate(knots.tolist()):
        offsets[k, inside] = interpolate_at(disc_knots, path.rows, s)
        offsets[k, len(members) :, _OPACITY_CHANNEL] = interpolate_at(disc_knots, path.rise, s)
    if recolored is not None:
        offsets[:, : len(members)] += _scaled_recolor_offsets(recolored, members, recolor_end, knots)
    field = course_field(knots, offsets)
    if recolored is not None:
        field = replace(field, recorded=recolored.field.recorded)
        gdf = replace(recolored, region=Region(name, members, score), field=field, added=start, anchors=None)
    else:
        gdf = Gdf(name, Region(name, members, score), field, fingerprint(scene), added=start)
    pushes = PUSHED_SHAPE if recolored is not None else PUSHED_SHAPE | {"color"}
    gdf = anchor_added(gdf, scene, pushes)
    return gdf if gdf.anchors is None else replace(gdf, anchors=replace(gdf.anchors, rim=laid.rim))


def _scaled_recolor_offsets(recolored: Gdf, members: Tensor, end: Tensor, knots: Tensor) -> Tensor:
    """Return a recolor's path, scaled per member so that it ends at `end`. [M], [M,C], [S] -> [S,M,C]"""
    field = recolored.field
    inside = torch.searchsorted(members, recolored.region.members)
    full_edit = field.offsets(1.0)
    shares = (end[inside] * full_edit).sum(dim=1) / full_edit.square().sum(dim=1).clamp_min(1e-20)
    paths = torch.zeros(len(knots), *end.shape)
    for k, s in enumerate(knots.tolist()):
        paths[k, inside] = shares[:, None] * field.offsets(s)
    return paths


@dataclass(frozen=True)
class _DiscPath:
    """Path from the original to the discs, before its visible change is linear."""

    __eq__ = equal_fields

    steps: Tensor  # positions on the path, ascending from 0 to 1. [S]
    rows: Tensor  # packed offsets of the changed rows. [S,M,C]
    rise: Tensor  # offsets of the discs' logits. [S,A]


def _overlap(added: Gaussians, paints: Sequence[PaintedView]) -> Tensor:
    """Return how many discs cover each disc's center in the painted pictures, by their footprints. [A]

    Discs are drawn faint, so that the logarithm of their transmittance counts all that cover a pixel.
    """
    faint_alpha = torch.tensor(_COUNTING_ALPHA)
    counted = replace(added, logit_opacities=torch.full((len(added),), float(faint_alpha.logit())))
    white = torch.ones(len(added), 3)
    overlap = torch.ones(len(added))
    for paint in paints:
        camera = paint.camera
        light = render(counted, camera, (0.0, 0.0, 0.0), colors=white).image[..., 0]
        count = (1.0 - light.double()).log() / (1.0 - faint_alpha.double()).log()
        inside = added.means.double() @ camera.viewmat[:3, :3].double().T + camera.viewmat[:3, 3].double()
        pixels = (inside / inside[:, 2:]) @ camera.K.double().T
        columns = pixels[:, 0].long().clamp(0, camera.width - 1)
        rows = pixels[:, 1].long().clamp(0, camera.height - 1)
        overlap = torch.maximum(overlap, count[rows, columns].float())
    return overlap


def _even_rise(start: Tensor, end: Tensor, overlap: Tensor, steps: Tensor) -> Tensor:
    """Return offsets of logits for which the opacity of overlapping discs together is linear. [S,A]

    Args:
        start, end: logits at the ends of the path. [A]
        overlap: see `_overlap`. [A]
        steps: positions on the path, ascending from 0 to 1. [S]
    """
    covered = 1.0 - (1.0 - end.double().sigmoid()) ** overlap.double()
    opacity = 1.0 - (1.0 - steps[:, None].double() * covered) ** (1.0 / overlap.double())
    offsets = (opacity.clamp_min(1e-12).logit() - start.double()).clamp_min(0.0).float()
    offsets[-1] = end - start
    return offsets


def _disc_path(laid: DiscLayout, paints: Sequence[PaintedView], with_shN: bool) -> _DiscPath:
    """Return the path of a layout.

    Gaussians move behind the discs first, while the discs are faint. Then the Gaussians that discs replace
    fade.
    """
    start = faint(laid.added).logit_opacities
    end = torch.full((len(laid.added),), DISC_LOGIT)
    steps = opacity_course(start, end)[0]
    rise = _even_rise(start, end, _overlap(laid.added, paints), steps)
    before = pack(laid.scene[laid.rows], with_shN=with_shN)
    after = pack(laid.ended[laid.rows], with_shN=with_shN)
    change = after - before
    shares = steps[:, None].expand(-1, change.shape[1]).clone()
    slices = attribute_slices(change.shape[1])
    for name in _GEOMETRY:
        shares[:, slices[name]] = (steps / _CLEARED_AT).clamp_max(1.0)[:, None]
    rows = shares[:, None] * change
    fading = ((steps - _CLEARED_AT) / (1.0 - _CLEARED_AT)).clamp_min(0.0)
    first = before[:, _OPACITY_CHANNEL].double().sigmoid()
    last = after[:, _OPACITY_CHANNEL].double().sigmoid()
    opacities = torch.lerp(first, last, fading[:, None].double())
    rows[..., _OPACITY_CHANNEL] = (opacities.logit() - first.logit()).float()
    rows[0] = 0.0
    rows[-1] = change
    return _DiscPath(steps, rows, rise)


def _linear_visibility_knots(laid: DiscLayout, paints: Sequence[PaintedView], path: _DiscPath) -> Tensor:
    """Return the strengths for the knots of a path, so that its visible change is linear. [S]"""
    paint = paints[0]
    box = box_of(paint.mask, paint.camera)
    painted = crop(paint.mask, box)
    with_shN = path.rows.shape[2] > BASE_CHANNELS
    start = pack(laid.scene[laid.rows], with_shN=with_shN)
    faint_discs = faint(laid.added)

    def look_at(g: float) -> Tensor:
        logits = faint_discs.logit_opacities + interpolate_at(path.steps, path.rise, g)
        moved = laid.scene.replace_rows(laid.rows, start + interpolate_at(path.steps, path.rows, g))
        now = concatenate([moved, replace(faint_discs, logit_opacities=logits)])
        return render(now, paint.camera, BACKGROUND, crop=box).image[painted]

    return linear_remap(look_at)(path.steps.double()).float()


def sharpen(
    scene: Gaussians,
    recolored: Gdf,
    pictures: Mapping[Path, Camera],
    is_named: bool,
    log: RunLog,
    seen: Gaussians | None = None,
) -> Gdf | None:
    """Return the edit with discs for paint finer than the Gaussians; None if there is none, or discs are no
    better.

    Args:
        scene: the original
        recolored: the best recolor
        pictures: changed pictures and the cameras used in training
        is_named: the user named the region, so paint stays inside it
        log: log of the run
        seen: see `read_edit`
    """
    end = edited_scene(scene, recolored)
    paints = list[PaintedView]()
    weights = torch.zeros(len(scene), 2)
    background = torch.tensor(BACKGROUND)
    for path, camera in pictures.items():
        view = make_view(scene, recolored.region, camera.resize(*picture_size(path)), background)
        target = read_edit(scene, view.camera, view.image, path, seen)
        target = (view if is_named else view.with_painted([target])).confine(target)
        paint, changed = _missed_paint(end, view, target)
        weights += torch.stack([alpha_weights(scene, view.camera, m)[:, 0] for m in (paint.mask, changed)], 1)
        if bool(paint.mask.any()):
            paints.append(paint)
    if not paints:
        return None
    members = recolored.region.members
    unpainted_shares = 1.0 - weights[members, 0] / weights[members, 1].clamp_min(1e-6)
    rows = pack(scene[members], with_shN=recolored.field.channels > BASE_CHANNELS)
    reverted = scene.replace_rows(members, rows + unpainted_shares[:, None] * recolored.field.offsets(1.0))
    # revert the recolor of painted members if that is better beside the paint, as between letters
    base = min((end, reverted), key=lambda one: sum(_error_beside(one, paint) for paint in paints))
    goal = make_goal(base, paints)
    try:
        laid = choose_discs(goal, log)
    except ProgdfError:
        return None
    groups = [[look for look in goal.views if (look.degrees != 0) is aside] for aside in (False, True)]
    errors = [[mean_square_error(one, group) for one in (end, laid.end)] for group in groups]
    improves = errors[0][1] < errors[0][0] and errors[1][1] <= errors[1][0]
    own_db, side_db = ([round(decibels(error), 1) for error in pair] for pair in errors)
    pixels = group_digits(sum(int(one.mask.sum()) for one in paints))
    discs = group_digits(len(laid.added))
    log.say(
        f"{pixels} painted pixels are finer than the Gaussians; {discs} discs reach {own_db[1]} dB instead "
        f"of {own_db[0]} by recoloring, and {side_db[1]} instead of {side_db[0]} from the sides: "
        + ("added" if improves else "not added")
    )
    return paint_gdf(laid, scene, paints, recolored.name, recolored) if improves else None


def _error_beside(finished: Gaussians, paint: PaintedView) -> float:
    """Return the sum of squared differences from the picture, outside the fine paint."""
    image = render_view(finished, paint.camera, torch.tensor(BACKGROUND)).clamp(0.0, 1.0)
    return float((image - paint.picture)[~paint.mask].square().sum())


def _missed_paint(end: Gaussians, view: View, target: Tensor) -> tuple[PaintedView, Tensor]:
    """Return the paint that a recolor misses in a picture, and the mask of all changed pixels. [H,W] bool"""
    changed = (target - view.image).abs().amax(dim=2) > _ROUNDING_COLOR
    image = render_view(end, view.camera, torch.tensor(BACKGROUND)).clamp(0.0, 1.0)
    missed = (
        ndimage.gaussian_filter((target - image).square().mean(dim=2).numpy(), _ERROR_SIGMA_PX)
        > _MISSED_COLOR**2
    )
    sharp = changed & torch.from_numpy(ndimage.binary_dilation(missed, iterations=BORDER_PX))
    drawn = torch.cat([target, torch.ones_like(target[..., :1])], dim=2) * sharp[..., None]
    surface = find_surface(end, view.camera, sharp.numpy())
    return PaintedView(view.camera, target, drawn, surface), changed
