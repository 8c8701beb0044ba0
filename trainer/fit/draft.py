"""Draft of a color edit: a single color map, fitted in a second before training starts.

An editor that maps every color to another one, independent of position, is nearly a color map itself. A small
number of views and 1500 of their pixels are then enough for a slider, until training has found the residuals
of single Gaussians. Test views, to which the map is not fitted, decide if it represents the edit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.field.baked import MONOMIALS, BakedField, identity_map
from progdf.field.grade import map_colors, map_form, member_bands
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from progdf.gdf.file import Gdf, fingerprint
from progdf.metrics.image import ROUNDING, decibels
from progdf.region import Region
from progdf.system.equality import equal_fields
from trainer.editors import editor_row, make_editor
from trainer.editors.procedural import ColorEditor, edit_course
from trainer.optimize.color_views import MAX_ERROR_SHARE, ColorMembers, ColorView, MapFit, fit_maps
from trainer.options import MAX_STAGES, EditorOptions, TrainingViewOptions
from trainer.views.setup import render_thumbnails
from trainer.views.view import BACKGROUND, RegionThumbnail, View, render_view

from .slider_uniformity import equalized_strengths

MAX_UNEXPLAINED_SHARE = 0.1
"""Largest share of an edit's squared change that a grade may leave unexplained."""

_FIT_PIXELS = 1500  # sampled from the fitting views
_TEST_PIXELS = 500  # sampled from the test views; a map has at most 60 values


@dataclass(frozen=True)
class _Pixels:
    """Sampled pixels of some views."""

    __eq__ = equal_fields

    row: View  # the pixels as one row of a picture, for the editor
    maps: MapFit  # fits color maps to the pixels
    views: Sequence[ColorView]
    places: Sequence[Tensor]  # indices of the pixels in each view. [p] int64
    seen: Tensor  # indices of the region's members that are visible in any view. [m] int64


@dataclass(frozen=True)
class DraftViews:
    """Pixels of a region for fitting and testing grades, independent of the edit's color."""

    scene: Gaussians
    region: Region
    glances: Sequence[RegionThumbnail]
    fitted: _Pixels
    judged: _Pixels  # from test views, to which nothing is fitted


def draft_views(options: TrainingViewOptions, scene: Gaussians, region: Region) -> DraftViews | None:
    """Sample small views of the region; None if fewer than two show it.

    A scene that surrounds the viewer and has no cameras gives None too.

    Args:
        options: see `TrainingViewOptions`
        scene: the original
        region: the edited region
    """
    glances = render_thumbnails(options, scene, region)
    members = ColorMembers.of(pack(scene[region.members], with_shN=scene.sh_degree > 0))
    views = [_glance_view(scene, members, glance) for glance in glances]
    parts = [[view for i, view in enumerate(views) if (i % 3 == 1) is is_test] for is_test in (False, True)]
    samples = [
        _sample(part, count) for part, count in zip(parts, (_FIT_PIXELS, _TEST_PIXELS), strict=True) if part
    ]
    if len(samples) < 2 or not all(len(sample.maps.design) for sample in samples):
        return None
    return DraftViews(scene, region, glances, *samples)


def _glance_view(scene: Gaussians, members: ColorMembers, glance: RegionThumbnail) -> tuple[View, ColorView]:
    """Return a thumbnail as a view and a color view whose pixels form one row."""
    background = torch.tensor(BACKGROUND)
    drawn = glance.map.picture(glance.colors.clamp_min(0.0))
    others = (1.0 - glance.mask[:, None]) * background
    if len(members.means) < len(scene):
        others = render_view(scene, glance.camera, background).flatten(0, 1)[glance.pixels] - drawn
    image = (others + drawn).clamp(0.0, 1.0)
    count = len(drawn)
    view = View(glance.camera, image[None], glance.mask[None], glance.inside[None], (0, 0, count, 1))
    row = torch.arange(count)
    evaluated = torch.ones_like(image[:, :1], dtype=torch.bool)
    position = glance.camera.position
    return view, ColorView(glance.map, others, members, position, (1, count), row, evaluated)


def _sample(looked: Sequence[tuple[View, ColorView]], most: int) -> _Pixels:
    """Sample about `most` evenly spread pixels of views."""
    views = [view for _, view in looked]
    maps = fit_maps(views, torch.ones(len(views[0].members.means)), most)

    def gather(images: Sequence[Tensor]) -> Tensor:
        return torch.cat([i.flatten(0, 1)[p] for i, p in zip(images, maps.pixels, strict=True)])[None]

    image, mask, inside = (gather([getattr(v, n) for v, _ in looked]) for n in ("image", "mask", "inside"))
    row = View(looked[0][0].camera, image, mask, inside, (0, 0, image.shape[1], 1))
    weights = [view.map.gradient(torch.ones_like(view.others))[:, 0] for view in views]
    seen = torch.stack(weights).sum(dim=0).nonzero()[:, 0]
    return _Pixels(row, replace(maps, pixels=[torch.arange(image.shape[1])]), views, maps.pixels, seen)


def _error(picture: Tensor, expected: Tensor) -> float:
    """Return the mean squared difference plus that of 8-bit rounding. [P,3], [1,P,3]"""
    return ROUNDING + float((picture - expected[0]).square().mean())


def draft_grade(views: DraftViews, options: EditorOptions, name: str) -> Gdf | None:
    """Fit the closest grade to an edit, at strengths with even visible change. Its field is not baked.

    The entry `draft` of its report has the map's degree, and its PSNR at strength 1 against the editor's
    pictures of the test views, dB.

    Returns:
        The grade; None if the editor is not a function of color, or if the grade leaves more than
        `MAX_UNEXPLAINED_SHARE` of the edit. A manual grade is always returned.

    Raises:
        ProgdfError: the editor does not exist.
    """
    row = editor_row(options)
    if not row.color_function:
        return None
    fitted = views.fitted
    judged = views.judged
    editor = make_editor(options, views.scene, views.region, (), lambda: views.glances)
    if not isinstance(editor, ColorEditor):
        return None  # clarity depends on the neighbors of a Gaussian
    plain = tuple((i + 1) / MAX_STAGES for i in range(MAX_STAGES))
    strengths = equalized_strengths(editor, options.editor, [fitted.row], plain)
    targets = list(map(edit_course(editor, fitted.row), strengths))
    expected = editor.edit(judged.row, 1.0)
    ends = {degree: fitted.maps.solve(degree, targets[-1:]) for degree in MONOMIALS}
    errors = {degree: _error(judged.maps.picture(end), expected) for degree, end in ends.items()}
    degree = min(d for d in errors if MAX_ERROR_SHARE * errors[d] <= min(errors.values()))
    error = _drawn_error(views, ends[degree], degree, expected)
    max_error = MAX_UNEXPLAINED_SHARE * _error(judged.row.image[0], expected) + ROUNDING
    if error > max_error and not row.is_manual:
        return None
    maps = [fitted.maps.solve(degree, [target]) for target in targets]
    knots = torch.tensor((0.0, *plain))
    table = torch.stack([identity_map(degree), *maps])
    form = map_form(knots, degree, table, len(views.region))
    channels = BASE_CHANNELS + 3 * views.scene.shN.shape[1]
    field = BakedField("grade", torch.tensor([0.0, 1.0]), {}, channels, tuple(knots.tolist()), form)
    report = {"draft": {"degree": degree, "psnr": round(decibels(error), 2)}}
    return Gdf(name, views.region, field, fingerprint(views.scene), options.editor, report=report)


def _drawn_error(views: DraftViews, table: Tensor, degree: int, expected: Tensor) -> float:
    """Return the error in the test views if the map changes the members' SH coefficients, not pixels."""
    judged = views.judged
    seen = views.judged.seen
    scene = views.scene[views.region.members[seen]]
    sh = member_bands(pack(scene, with_shN=scene.sh_degree > 0))
    offsets = sh.new_zeros(len(views.region), *sh.shape[1:])
    offsets[seen] = map_colors(sh, table, degree) - sh
    pictures = [view.picture(view.colors(offsets)).clamp(0.0, 1.0) for view in judged.views]
    sampled = [picture[places] for picture, places in zip(pictures, judged.places, strict=True)]
    return _error(torch.cat(sampled), expected)
