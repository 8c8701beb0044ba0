"""A grade alone, before anything is trained: what one map of color makes of an edit, in a second.

An editor that gives every color another one, wherever it is, is nearly a map of color itself. So a few views
and some thousand of their pixels are all that a slider needs until the training has found what single
Gaussians need beside it. Whether the map carries the edit is measured on views that it was not fitted to.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.field.baked import MONOMIALS, BakedField, identity_map
from progdf.field.grade import map_colors, map_form, member_bands
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from progdf.gdf.file import Gdf, fingerprint
from progdf.io.cameras import load_cameras
from progdf.metrics.image import ROUNDING, decibels
from progdf.rasterize import activate, render
from progdf.rasterize.engines import color_map
from progdf.region import Region
from progdf.scene.bounds import is_surrounding
from progdf.scene.up_axis import find_up
from progdf.sh import basis
from trainer.editors import COLOR_FUNCTIONS, make_editor
from trainer.editors.procedural import edit_course
from trainer.optimize.color_views import MORE_PAYS, ColorView, MapFit, fit_maps
from trainer.options import MOST_STAGES, EditorOptions, ViewOptions
from trainer.views.view import BACKGROUND, View, fit_size, region_rig, with_near_plane

from .slider_uniformity import equalized_strengths

CARRIED = 0.1
"""Of what an edit changes, mean square: a grade that leaves more does not carry it."""

_SIZE = 192  # pixels of a view; smaller ones mix colors, and the region's typical color with them
_ROUNDS, _VIEWS = 5, 3  # most rounds of new views, and views of a round, of which one is not fitted to
_SECONDS = 0.5  # of the processor, after which no round follows
_SETTLED = 0.99  # of the error: what the views of a round must get it below, for another round to follow
_EVERY = 5  # which of its pixels, along the rows, are looked at
_FITTED, _JUDGED = 1500, 500  # pixels that represent those of all views; a map has 60 numbers at most
_EVENED = 6  # every such one of them decides how fast the slider goes


@dataclass(frozen=True)
class _Pixels:
    """Pixels of some views."""

    row: View  # as one row of a picture, which an editor edits as any
    maps: MapFit  # what a map makes of that
    views: Sequence[ColorView]
    places: Sequence[Tensor]  # which pixels of each view these are. [p] int64
    seen: Tensor  # which of the region's members show in any of them. [m] int64


@dataclass(frozen=True)
class DraftViews:
    """What grades of a region are fitted to and judged by, whatever the color."""

    scene: Gaussians
    region: Region
    fitted: _Pixels
    judged: _Pixels  # of views that nothing is fitted to


def draft_views(options: ViewOptions, editor: str, scene: Gaussians, region: Region) -> DraftViews | None:
    """A few small views; more of them as long as these take a hundredth of the error away.

    None where nothing is to be seen: no view shows the region, or the scene is one to stand inside.

    Args:
        options: see `ViewOptions`
        editor: whose error decides how many there are
        scene: the original
        region: what is edited
    """
    given = [] if options.cameras is None else load_cameras(options.cameras, scene.origin)
    up = find_up(scene, given, options.up, options.scene).direction
    if given:
        cameras = [fit_size(c, _SIZE) for c in given[:: -(-len(given) // (_ROUNDS * _VIEWS))]]
    elif is_surrounding(scene, up):
        return None
    else:
        cameras = region_rig(scene, region, _ROUNDS * _VIEWS, _SIZE, up)
    began, looked, views = time.process_time(), list[tuple[View, ColorView]](), None
    for number in range(_ROUNDS):
        added = with_near_plane(cameras[number::_ROUNDS], scene)
        looked += [_look(scene, region, camera) for camera in added]
        last, fitted = views, [look for i, look in enumerate(looked) if i % _VIEWS != _VIEWS // 2]
        parts = _sample(fitted, _FITTED), _sample(looked[_VIEWS // 2 :: _VIEWS], _JUDGED)
        if not all(len(part.maps.design) for part in parts):
            return None
        views = DraftViews(scene, region, *parts)
        settled = last is not None and not _gains(last, views, editor)
        if settled or time.process_time() - began > _SECONDS:
            break
    return views


def _look(scene: Gaussians, region: Region, camera: Camera) -> tuple[View, ColorView]:
    """`make_view` and `color_view` of some pixels, as one row, of which each Gaussian is projected twice at
    most."""
    members, background = region.members, torch.tensor(BACKGROUND)
    weights = basis(min(scene.sh_degree, 3), torch.nn.functional.normalize(scene.means - camera.position))
    colors = torch.einsum("nb,nbc->nc", weights, scene.sh[:, : weights.shape[1]]) + 0.5
    pixels, shown = torch.arange(camera.width * camera.height)[::_EVERY], colors[members]
    count, activated = len(pixels), activate(scene, colors.clamp_min(0.0))
    weighed = color_map(activated, camera, (0, 0, camera.width, camera.height), members, pixels=pixels)
    share = weighed.picture(torch.ones(len(members), 3))[..., :1]
    drawn = weighed.picture(shown.clamp_min(0.0))
    others = (1.0 - share) * background
    if len(members) < len(scene):
        with torch.no_grad():
            others = render(activated, camera, background).image.flatten(0, 1)[pixels] - drawn
    image, mask = (others + drawn).clamp(0.0, 1.0), share[:, 0].clamp(0.0, 1.0)
    inside = (drawn / share.clamp_min(1e-4)).clamp(0.0, 1.0)
    view = View(camera, image[None], mask[None], inside[None], (0, 0, count, 1))
    row, counts = torch.arange(count), torch.ones_like(share, dtype=torch.bool)
    return view, ColorView(weighed, others, weights[members], shown, (1, count), row, counts)


def _sample(looked: Sequence[tuple[View, ColorView]], most: int) -> _Pixels:
    """Evenly spread pixels of views."""
    views = [view for _, view in looked]
    maps = fit_maps(views, torch.ones(len(views[0].original)), most)

    def gather(images: Sequence[Tensor]) -> Tensor:
        return torch.cat([i.flatten(0, 1)[p] for i, p in zip(images, maps.pixels, strict=True)])[None]

    image, mask, inside = (gather([getattr(v, n) for v, _ in looked]) for n in ("image", "mask", "inside"))
    row = View(looked[0][0].camera, image, mask, inside, (0, 0, image.shape[1], 1))
    weights = torch.zeros(len(views[0].original))
    for view, places in zip(views, maps.pixels, strict=True):
        weights += view.map.gradient(torch.zeros_like(view.others).index_fill_(0, places, 1.0))[:, 0]
    seen = weights.nonzero()[:, 0]
    return _Pixels(row, replace(maps, pixels=[torch.arange(image.shape[1])]), views, maps.pixels, seen)


def _gains(last: DraftViews, views: DraftViews, spec: str) -> bool:
    """Whether more views have made a map better in those that neither was fitted to."""
    rows = [views.fitted.row, views.judged.row]
    editor = make_editor(EditorOptions(spec), views.scene, views.region, rows)
    expected = editor.edit(views.judged.row, 1.0)
    tables = [some.fitted.maps.solve(2, [editor.edit(some.fitted.row, 1.0)]) for some in (last, views)]
    before, after = (_error(views.judged.maps.picture(table), expected) for table in tables)
    return after < _SETTLED * before


def _error(picture: Tensor, expected: Tensor) -> float:
    """Mean squared difference. [P,3], [1,P,3]"""
    return ROUNDING + float((picture - expected[0]).square().mean())


def draft_grade(views: DraftViews, options: EditorOptions, name: str) -> Gdf | None:
    """The grade that comes nearest to an edit at strengths that are evenly visible, its field not baked; None
    where it leaves more than `CARRIED` of it, unless it is a grade by hand, or the editor is no function of
    color.

    `draft` in its report has the map's degree, and its dB at strength 1 to the editor's own pictures of the
    views that it was not fitted to.

    Raises:
        ProgdfError: there is no such editor.
    """
    if options.family not in COLOR_FUNCTIONS:
        return None
    fitted, judged = views.fitted, views.judged
    editor = make_editor(options, views.scene, views.region, [fitted.row, judged.row])
    courses = [edit_course(editor, row) for row in (fitted.row, judged.row)]
    plain = tuple((i + 1) / MOST_STAGES for i in range(MOST_STAGES))
    strengths = equalized_strengths(editor, options.editor, [_thin(fitted.row)], plain)
    targets, expected = ([edit(s) for s in strengths] for edit in courses)
    ends = {degree: fitted.maps.solve(degree, targets[-1:]) for degree in MONOMIALS}
    errors = {degree: _error(judged.maps.picture(end), expected[-1]) for degree, end in ends.items()}
    degree = min(d for d in errors if MORE_PAYS * errors[d] <= min(errors.values()))
    error = _drawn_error(views, ends[degree], degree, expected[-1])
    carried = CARRIED * _error(judged.row.image[0], expected[-1]) + ROUNDING
    if error > carried and options.family != "grade":  # by hand one judges what one sees
        return None
    solve = partial(fitted.maps.solve, degree)
    table = torch.stack([identity_map(degree), *(solve([target]) for target in targets)])
    every = _knots(judged, table, expected)
    knots, table = torch.tensor((0.0, *plain))[::every], table[::every]
    form = map_form(knots, degree, table, len(views.region))
    channels = BASE_CHANNELS + 3 * views.scene.shN.shape[1]
    field = BakedField("grade", torch.tensor([0.0, 1.0]), {}, channels, tuple(knots.tolist()), form)
    about = {"draft": {"degree": degree, "psnr": round(decibels(error), 2)}}
    return Gdf(name, views.region, field, fingerprint(views.scene), options.editor, report=about)


def _thin(row: View) -> View:
    """A part of the pixels."""
    image, mask, inside = (part[:, ::_EVENED] for part in (row.image, row.mask, row.inside))
    return replace(row, image=image, mask=mask, inside=inside)


def _knots(judged: _Pixels, table: Tensor, expected: Sequence[Tensor]) -> int:
    """Every which of the maps is enough: those between take at most a twentieth away. [S,K,3]"""
    strengths = torch.arange(len(table))

    def error(every: int) -> float:
        left, share = strengths // every * every, (strengths % every) / every
        right = (left + every).clamp_max(len(table) - 1)
        course = torch.lerp(table[left], table[right], share[:, None, None])
        return sum(_error(judged.maps.picture(t), e) for t, e in zip(course[1:], expected, strict=True))

    least = error(1)
    return next(every for every in (8, 4, 2, 1) if MORE_PAYS * error(every) <= least)


def _drawn_error(views: DraftViews, table: Tensor, degree: int, expected: Tensor) -> float:
    """What is left where the map is held as the members' own spherical harmonics, as a scene has it."""
    judged, seen = views.judged, views.judged.seen
    scene = views.scene[views.region.members[seen]]
    sh = member_bands(pack(scene, with_shN=scene.sh_degree > 0))
    offsets = sh.new_zeros(len(views.region), *sh.shape[1:])
    offsets[seen] = map_colors(sh, table, degree) - sh
    pictures = [view.picture(view.colors(offsets)).clamp(0.0, 1.0) for view in judged.views]
    shown = [picture[places] for picture, places in zip(pictures, judged.places, strict=True)]
    return _error(torch.cat(shown), expected)
