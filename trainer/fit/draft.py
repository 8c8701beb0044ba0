"""A grade alone, before anything is trained: what one map of color makes of an edit, in a second.

An editor that gives every color another one, wherever it is, is nearly a map of color itself. So a few views
and some thousand of their pixels are all that a slider needs until the training has found what single
Gaussians need beside it. Whether the map carries the edit is measured on views that it was not fitted to.
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
from trainer.editors import COLOR_FUNCTIONS, make_editor
from trainer.editors.procedural import edit_course
from trainer.optimize.color_views import MORE_PAYS, ColorView, MapFit, fit_maps
from trainer.options import MAX_STAGES, EditorOptions, TrainingViewOptions
from trainer.setup import take_glances
from trainer.views.view import BACKGROUND, Glance, View, render_view

from .slider_uniformity import equalized_strengths

CARRIED = 0.1
"""Of what an edit changes, mean square: a grade that leaves more does not carry it."""

_FITTED = 1500  # pixels that represent those of all views
_JUDGED = 500  # a map has 60 numbers at most


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
    glances: Sequence[Glance]
    fitted: _Pixels
    judged: _Pixels  # of views that nothing is fitted to


def draft_views(options: TrainingViewOptions, scene: Gaussians, region: Region) -> DraftViews | None:
    """The region at a glance; None where fewer than two show it, or the scene is one to stand inside.

    Args:
        options: see `TrainingViewOptions`
        scene: the original
        region: what is edited
    """
    glances = take_glances(options, scene, region)
    looked = [_look(scene, region, one) for one in glances]
    parts = [[look for i, look in enumerate(looked) if (i % 3 == 1) is aside] for aside in (False, True)]
    samples = [_sample(part, most) for part, most in zip(parts, (_FITTED, _JUDGED), strict=True) if part]
    if len(samples) < 2 or not all(len(sample.maps.design) for sample in samples):
        return None
    return DraftViews(scene, region, glances, *samples)


def _look(scene: Gaussians, region: Region, glance: Glance) -> tuple[View, ColorView]:
    """A glance as views of one row."""
    background = torch.tensor(BACKGROUND)
    drawn = glance.map.picture(glance.colors.clamp_min(0.0))
    others = (1.0 - glance.mask[:, None]) * background
    if len(region) < len(scene):
        others = render_view(scene, glance.camera, background).flatten(0, 1)[glance.pixels] - drawn
    image = (others + drawn).clamp(0.0, 1.0)
    count = len(drawn)
    view = View(glance.camera, image[None], glance.mask[None], glance.inside[None], (0, 0, count, 1))
    row = torch.arange(count)
    counts = torch.ones_like(image[:, :1], dtype=torch.bool)
    return view, ColorView(glance.map, others, glance.basis, glance.colors, (1, count), row, counts)


def _sample(looked: Sequence[tuple[View, ColorView]], most: int) -> _Pixels:
    """Evenly spread pixels of views."""
    views = [view for _, view in looked]
    maps = fit_maps(views, torch.ones(len(views[0].original)), most)

    def gather(images: Sequence[Tensor]) -> Tensor:
        return torch.cat([i.flatten(0, 1)[p] for i, p in zip(images, maps.pixels, strict=True)])[None]

    image, mask, inside = (gather([getattr(v, n) for v, _ in looked]) for n in ("image", "mask", "inside"))
    row = View(looked[0][0].camera, image, mask, inside, (0, 0, image.shape[1], 1))
    weights = [view.map.gradient(torch.ones_like(view.others))[:, 0] for view in views]
    seen = torch.stack(weights).sum(dim=0).nonzero()[:, 0]
    return _Pixels(row, replace(maps, pixels=[torch.arange(image.shape[1])]), views, maps.pixels, seen)


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
    fitted = views.fitted
    judged = views.judged
    editor = make_editor(options, views.scene, views.region, (), lambda: views.glances)
    plain = tuple((i + 1) / MAX_STAGES for i in range(MAX_STAGES))
    strengths = equalized_strengths(editor, options.editor, [fitted.row], plain)
    targets = list(map(edit_course(editor, fitted.row), strengths))
    expected = editor.edit(judged.row, 1.0)
    ends = {degree: fitted.maps.solve(degree, targets[-1:]) for degree in MONOMIALS}
    errors = {degree: _error(judged.maps.picture(end), expected) for degree, end in ends.items()}
    degree = min(d for d in errors if MORE_PAYS * errors[d] <= min(errors.values()))
    error = _drawn_error(views, ends[degree], degree, expected)
    carried = CARRIED * _error(judged.row.image[0], expected) + ROUNDING
    if error > carried and options.family != "grade":  # by hand one judges what one sees
        return None
    maps = [fitted.maps.solve(degree, [target]) for target in targets]
    knots = torch.tensor((0.0, *plain))
    table = torch.stack([identity_map(degree), *maps])
    form = map_form(knots, degree, table, len(views.region))
    channels = BASE_CHANNELS + 3 * views.scene.shN.shape[1]
    field = BakedField("grade", torch.tensor([0.0, 1.0]), {}, channels, tuple(knots.tolist()), form)
    about = {"draft": {"degree": degree, "psnr": round(decibels(error), 2)}}
    return Gdf(name, views.region, field, fingerprint(views.scene), options.editor, report=about)


def _drawn_error(views: DraftViews, table: Tensor, degree: int, expected: Tensor) -> float:
    """What is left where the map is held as the members' own spherical harmonics, as a scene has it."""
    judged = views.judged
    seen = views.judged.seen
    scene = views.scene[views.region.members[seen]]
    sh = member_bands(pack(scene, with_shN=scene.sh_degree > 0))
    offsets = sh.new_zeros(len(views.region), *sh.shape[1:])
    offsets[seen] = map_colors(sh, table, degree) - sh
    pictures = [view.picture(view.colors(offsets)).clamp(0.0, 1.0) for view in judged.views]
    shown = [picture[places] for picture, places in zip(pictures, judged.places, strict=True)]
    return _error(torch.cat(shown), expected)
