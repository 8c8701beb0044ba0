"""Paint that is finer than the Gaussians becomes discs: a decal's, and what recoloring leaves of pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from progdf.camera import Camera
from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError
from progdf.field.baked import interpolate_at
from progdf.field.separable import course_field, opacity_course
from progdf.gaussians import BASE_CHANNELS, Gaussians, concatenate, pack
from progdf.gdf.file import Gdf, fingerprint
from progdf.io.images import picture_size
from progdf.metrics.image import decibels, psnr
from progdf.quaternions import rotate_vectors
from progdf.rasterize import alpha_weights, render
from progdf.rasterize.engines import render_depth
from progdf.region import Region
from progdf.terminal import group_digits
from trainer.editors.decal import DecalEditor
from trainer.editors.pictures import read_edit
from trainer.paint.discs import DISC_LOGIT, GROWN, PaintedView, faint, lay_on, place_discs, project_paint
from trainer.paint.solve import box_of, solve_colors
from trainer.store.progress import RunLog
from trainer.views.view import BACKGROUND, View, crop, make_view, render_view

RING = 15
"""Pixels around the paint that must stay as they are."""
TURNS = (-45, -30, -15, 0, 15, 30, 45)
"""Degrees about what is painted, from which it is measured."""

_TRIAL_TURNS = (-30, -15, 0, 15, 30)
_GAPS = (4.0, 1.0)  # pixels between discs and what is moved behind them, which are tried
_FLAT = 0.015  # root mean square of color that one disc may be off, over its pixels
_SPOILED = 1 / 255  # of color, by which what was moved shows beside the paint
_MIN_SHOWN = 0.5  # pixels of that, from which a row's color may change
_ALIKE = 0.05  # of color, by which a pixel is told from what was painted
_ROUNDED = 1.5 / 255  # two images in 8 bits differ by as much
_WINDOW = 2.0  # pixels over which what is missing is taken together
_LOOKS = 12  # strengths at which what shows is measured
_LOGIT = 10  # channel of the opacity in a packed row, see `attribute_slices`


@dataclass(frozen=True)
class Laid:
    """Paint as discs."""

    scene: Gaussians  # what they are laid on, as at strength 1
    ended: Gaussians  # its rows when they have made way
    rows: Tensor  # those that do. [M] int64
    added: Gaussians  # the discs as at strength 1
    gap: float  # pixels between these and what was moved

    @property
    def end(self) -> Gaussians:
        """The scene with the paint, the discs after its own rows."""
        return concatenate([self.ended, self.added])


def lay_discs(scene: Gaussians, paints: Sequence[PaintedView], gap: float) -> Laid:
    """Discs for what is painted: of each picture where none of those before it is seen.

    Args:
        scene: what they are laid on
        paints: of one thing
        gap: see `place_discs`
    """
    cleared = scene
    added = scene[:0]
    changed = torch.zeros(len(scene), dtype=torch.bool)
    for paint in paints:
        fresh = paint
        if len(added):
            colors = torch.cat([torch.zeros(len(scene), 3), torch.ones(len(added), 3)])
            both = concatenate([cleared, added])
            shown = render(both, paint.camera, (0.0, 0.0, 0.0), colors=colors).image[..., 0]
            # as discs are beside paint
            near = ndimage.binary_dilation((shown > 0.5).numpy(), iterations=GROWN)
            fresh = replace(paint, drawn=paint.drawn * ~torch.from_numpy(near)[..., None])
        discs = place_discs(scene, fresh, _FLAT, gap, cleared)
        cleared = discs.scene
        added = concatenate([added, discs.added])
        changed[discs.moved] = True
    for paint in paints:
        box = box_of(paint.mask, paint.camera)
        before, after = (render(some, paint.camera, BACKGROUND, crop=box).image for some in (scene, cleared))
        beside = ~ndimage.binary_dilation(paint.mask.numpy(), iterations=GROWN)
        spoiled = torch.zeros_like(paint.mask)
        crop(spoiled, box)[:] = (after - before).abs().amax(dim=2) > _SPOILED
        light = alpha_weights(cleared, paint.camera, spoiled & torch.from_numpy(beside))[:, 0]
        changed |= light > _MIN_SHOWN
    rows = changed.nonzero()[:, 0]
    ended, added = solve_colors(cleared, rows, added, paints)
    return Laid(scene, ended, rows, added, gap)


@dataclass(frozen=True)
class PaintView:
    """A view around the paint, and what of it counts."""

    camera: Camera
    degrees: float  # by which it is turned; 0: that of the picture
    expected: Tensor  # the paint laid on the surface. [H,W,3]
    covered: Tensor  # where it lies. [H,W] bool
    around: Tensor  # and the ring beside it. [H,W] bool


def look_around(scene: Gaussians, paints: Sequence[PaintedView], degrees: Sequence[float]) -> list[PaintView]:
    """What the views of paint, turned about it, shall show.

    Args:
        scene: what it is laid on
        paints: of one thing
        degrees: by which each one's camera is turned; 0 is the picture itself
    """
    background = torch.tensor(BACKGROUND)
    looks = []
    for paint in paints:
        pivot = _pivot(scene, paint)
        for angle in degrees:
            camera = orbit(paint.camera, pivot, angle) if angle else paint.camera
            if angle:
                expected = render_view(scene, camera, background).clamp(0.0, 1.0)
                covered = torch.zeros(expected.shape[:2], dtype=torch.bool)
                for other in paints:
                    laid = project_paint(scene, other.camera, other.drawn, camera)
                    expected = lay_on(expected, laid)
                    covered = covered | (laid[..., 3] > 0)
            else:
                expected = paint.picture
                covered = paint.mask
            grown = ndimage.binary_dilation(covered.numpy(), iterations=RING)
            looks.append(PaintView(camera, angle, expected, covered, torch.from_numpy(grown) & ~covered))
    return looks


def _error(finished: Gaussians, looks: Sequence[PaintView]) -> float:
    """Mean square of color at and around the paint, over all looks."""
    error = pixels = 0.0
    for look in looks:
        counts = look.covered | look.around
        if not bool(counts.any()):
            continue
        box = box_of(counts, look.camera)
        shown = render(finished, look.camera, BACKGROUND, crop=box).image.clamp(0.0, 1.0)
        error += float((shown - crop(look.expected, box))[crop(counts, box)].square().sum())
        pixels += 3 * int(counts.sum())
    return error / max(1.0, pixels)


def choose_discs(
    scene: Gaussians, paints: Sequence[PaintedView], looks: Sequence[PaintView], log: RunLog | None
) -> Laid:
    """Discs with the gap that comes closest to the paint, in its own views and from the sides.

    Args:
        scene: what they are laid on
        paints: of one thing
        looks: see `look_around`
        log: of the run

    Raises:
        ProgdfError: nothing is painted on anything opaque.
    """
    tried = list[tuple[float, Laid]]()
    for gap in _GAPS:
        laid = lay_discs(scene, paints, gap)
        if not len(laid.added):
            raise ProgdfError("nothing is painted where the picture is opaque; paint on the scene")
        tried.append((_error(laid.end, looks), laid))
    best = min(tried, key=lambda one: one[0])
    if log is not None:
        errors = ", ".join(f"{decibels(error):.1f} dB with {laid.gap:g}" for error, laid in tried)
        log.say(
            f"what lay before the paint goes {best[1].gap:g} pixels behind it: {errors}, in and "
            f"{RING} pixels around it, as painted and from up to {max(_TRIAL_TURNS)}° to its sides"
        )
    return best[1]


def paint_gdf(
    laid: Laid, scene: Gaussians, paints: Sequence[PaintedView], name: str, recolored: Gdf | None
) -> Gdf:
    """The edit that ends in discs; what shows of them is linear in the strength.

    Args:
        laid: the discs
        scene: the original
        paints: of the discs
        name: of the layer
        recolored: what changes the scene beside them; the discs lie on its end, or on what is left of it
    """
    members = torch.unique(torch.cat([laid.rows, recolored.region.members])) if recolored else laid.rows
    score = torch.zeros(len(scene)) if recolored is None else recolored.region.score.clone()
    score[laid.rows] = 1.0
    channels = BASE_CHANNELS if recolored is None else recolored.field.channels
    bands = channels > BASE_CHANNELS
    base = laid.scene
    start = faint(laid.added)
    change = pack(laid.ended[members], with_shN=bands) - pack(base[members], with_shN=bands)
    steps, rise = opacity_course(start.logit_opacities, torch.full((len(start),), DISC_LOGIT))
    clock = _even_clock(laid, paints, steps, rise)
    knots = clock
    course = torch.zeros(len(members), channels)
    if recolored is not None:
        knots = torch.unique(torch.cat([clock, recolored.field.knots]))
        course = pack(base[members], with_shN=bands) - pack(scene[members], with_shN=bands)
    offsets = torch.zeros(len(knots), len(members) + len(start), channels)
    for k, s in enumerate(knots.tolist()):
        offsets[k, : len(members)] = interpolate_at(clock, steps, s) * change
        offsets[k, len(members) :, _LOGIT] = interpolate_at(clock, rise, s)
    if recolored is not None:
        offsets[:, : len(members)] += _shares(recolored, members, course, knots)
    field = course_field(knots, offsets)
    if recolored is not None:
        field = replace(field, recorded=recolored.field.recorded)
        return replace(recolored, region=Region(name, members, score), field=field, added=start)
    return Gdf(name, Region(name, members, score), field, fingerprint(scene), added=start)


def _shares(recolored: Gdf, members: Tensor, end: Tensor, knots: Tensor) -> Tensor:
    """The course of a recolor whose end is `end`, which is a share of its own. [M], [M,C], [S] -> [S,M,C]"""
    field = recolored.field
    inside = torch.searchsorted(members, recolored.region.members)
    whole = field.offsets(1.0)
    kept = (end[inside] * whole).sum(dim=1) / whole.square().sum(dim=1).clamp_min(1e-20)
    courses = torch.zeros(len(knots), *end.shape)
    for k, s in enumerate(knots.tolist()):
        courses[k, inside] = kept[:, None] * field.offsets(s)
    return courses


def _even_clock(laid: Laid, paints: Sequence[PaintedView], steps: Tensor, rise: Tensor) -> Tensor:
    """Strengths at which the knots of a straight course come, so that what shows is linear in them. [S]"""
    paint = paints[0]
    box = box_of(paint.mask, paint.camera)
    painted, start = crop(paint.mask, box), pack(laid.scene[laid.rows])
    way, hidden = pack(laid.ended[laid.rows]) - start, faint(laid.added)

    def look_at(g: float) -> Tensor:
        logits = hidden.logit_opacities + interpolate_at(steps, rise, g)
        moved = laid.scene.replace_rows(laid.rows, start + g * way)
        now = concatenate([moved, replace(hidden, logit_opacities=logits)])
        return render(now, paint.camera, BACKGROUND, crop=box).image[painted]

    first = look_at(0.0)
    last = look_at(1.0)
    change = last - first
    at = np.linspace(0.0, 1.0, _LOOKS + 1)
    shares = [float(((look_at(g) - first) * change).sum() / change.square().sum()) for g in at[1:-1]]
    course = np.maximum.accumulate(np.clip([0.0, *shares, 1.0], 0.0, 1.0))
    course = 0.98 * course + 0.02 * at  # ascends
    return torch.from_numpy(np.interp(steps.double().numpy(), at, course)).float()


def sharpen(
    scene: Gaussians, recolored: Gdf, pictures: Mapping[Path, Camera], is_named: bool, log: RunLog
) -> Gdf | None:
    """The edit with discs where paint is finer than the Gaussians; None where there is none, or they lose.

    Args:
        scene: the original
        recolored: what the best recolor is
        pictures: changed pictures, and the cameras that they are trained with
        is_named: paint stays within the edit's region, which was not found by the pictures
        log: of the run
    """
    end = edited_scene(scene, recolored)
    paints, light, background = list[PaintedView](), torch.zeros(len(scene), 2), torch.tensor(BACKGROUND)
    for path, camera in pictures.items():
        view = make_view(scene, recolored.region, camera.resize(*picture_size(path)), background)
        target = read_edit(scene, view.camera, view.image, path)
        target = (view if is_named else view.with_painted([target])).confine(target)
        paint, changed = _missed_paint(end, view, target)
        light += torch.stack([alpha_weights(scene, view.camera, m)[:, 0] for m in (paint.mask, changed)], 1)
        paints += [paint] if bool(paint.mask.any()) else []
    if not paints:
        return None
    members = recolored.region.members
    left = 1.0 - light[members, 0] / light[members, 1].clamp_min(1e-6)
    rows = pack(scene[members], with_shN=recolored.field.channels > BASE_CHANNELS)
    back = scene.replace_rows(members, rows + left[:, None] * recolored.field.offsets(1.0))
    # what is painted sharp goes back to what it was where that is better beside the paint, as between letters
    base = min((end, back), key=lambda one: sum(_error_beside(one, paint) for paint in paints))
    looks = look_around(base, paints, _TRIAL_TURNS)
    try:
        laid = choose_discs(base, paints, looks, log)
    except ProgdfError:
        return None
    parts = [[look for look in looks if (look.degrees != 0) is aside] for aside in (False, True)]
    errors = [[_error(one, some) for one in (end, laid.end)] for some in parts]
    keeps = errors[0][1] < errors[0][0] and errors[1][1] <= errors[1][0]
    own_db, side_db = ([round(decibels(error), 1) for error in pair] for pair in errors)
    pixels = group_digits(sum(int(one.mask.sum()) for one in paints))
    discs = group_digits(len(laid.added))
    log.say(
        f"{pixels} painted pixels are finer than the Gaussians: {discs} discs for them have {own_db[1]} dB "
        f"where recoloring has {own_db[0]}, from their sides {side_db[1]} where it has {side_db[0]}: "
        + ("they are added" if keeps else "none is added")
    )
    return paint_gdf(laid, scene, paints, recolored.name, recolored) if keeps else None


def _error_beside(finished: Gaussians, paint: PaintedView) -> float:
    """Sum of squared differences from the picture, but for what is painted sharp."""
    shown = render_view(finished, paint.camera, torch.tensor(BACKGROUND)).clamp(0.0, 1.0)
    return float((shown - paint.picture)[~paint.mask].square().sum())


def _missed_paint(end: Gaussians, view: View, target: Tensor) -> tuple[PaintedView, Tensor]:
    """What a recolor misses of a picture, and all that was painted. [H,W] bool"""
    changed = (target - view.image).abs().amax(dim=2) > _ROUNDED
    shown = render_view(end, view.camera, torch.tensor(BACKGROUND)).clamp(0.0, 1.0)
    rough = ndimage.gaussian_filter((target - shown).square().mean(dim=2).numpy(), _WINDOW) > _ALIKE**2
    sharp = changed & torch.from_numpy(ndimage.binary_dilation(rough, iterations=GROWN))
    drawn = torch.cat([target, torch.ones_like(target[..., :1])], dim=2) * sharp[..., None]
    return PaintedView(view.camera, target, drawn), changed


@dataclass(frozen=True)
class Painted:
    """An edit that adds discs, and how well it shows what was painted."""

    gdf: Gdf
    figures: dict[str, Any]  # for report.json
    expected: list[Tensor]  # what the views of `TURNS` shall show. [H,W,3] each
    shown: list[Tensor]  # and what they show


def train_decal(editor: DecalEditor, scene: Gaussians, name: str, log: RunLog | None = None) -> Painted:
    """The edit of a decal, measured in its own view and around it.

    Args:
        editor: see `DecalEditor`
        scene: the original
        name: of the layer
        log: of the run
    """
    paints = [editor.paint]
    laid = choose_discs(scene, paints, look_around(scene, paints, _TRIAL_TURNS), log)
    gdf = paint_gdf(laid, scene, paints, name, None)
    edited = edited_scene(scene, gdf)
    background = torch.tensor(BACKGROUND)
    looks = look_around(scene, paints, TURNS)
    shown = [render_view(edited, look.camera, background).clamp(0.0, 1.0) for look in looks]
    errors = [
        round(psnr(image, look.expected, look.covered), 2) if bool(look.covered.any()) else None
        for image, look in zip(shown, looks, strict=True)
    ]
    middle = TURNS.index(0)
    figures = {
        "pixels": int(paints[0].mask.sum()),
        "added": 0 if gdf.added is None else len(gdf.added),
        "moved": len(gdf.region),
        "own": errors[middle],
        "ring": round(psnr(shown[middle], looks[middle].expected, looks[middle].around), 2),
        "turned": {f"{degrees:+d}": error for degrees, error in zip(TURNS, errors, strict=True)},
    }
    return Painted(gdf, figures, [look.expected for look in looks], shown)


def _pivot(scene: Gaussians, paint: PaintedView) -> Tensor:
    """The point of the surface under the painted pixel that is nearest to the middle of all. [3]"""
    camera = paint.camera
    pixels = paint.mask.nonzero()
    row, column = pixels[int((pixels - pixels.float().mean(dim=0)).norm(dim=1).argmin())].tolist()
    depth = render_depth(scene, camera, crop=(column, row, column + 1, row + 1)).depth[0, 0].double()
    K = camera.K.double()
    c2w = camera.c2w.double()
    ray = torch.stack([(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], torch.ones(())])
    return c2w[:3, :3] @ (depth * ray) + c2w[:3, 3]


def orbit(camera: Camera, pivot: Tensor, degrees: float) -> Camera:
    """The camera turned about an axis through a point that is upright in its picture."""
    c2w = camera.c2w.double()
    axis = c2w[:3, 1]
    half = 0.5 * math.radians(degrees)
    turn = torch.cat([torch.tensor([math.cos(half)]).double(), math.sin(half) * axis])
    turned = torch.eye(4, dtype=torch.float64)
    turned[:3, :3] = rotate_vectors(c2w[:3, :3].T, turn[None]).T
    turned[:3, 3] = pivot.double() + rotate_vectors(c2w[:3, 3] - pivot.double(), turn)
    return replace(camera, viewmat=torch.linalg.inv(turned).float(), name=f"decal{degrees:+.0f}")
