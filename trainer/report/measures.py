"""What a run reached: errors over the slider on held-out views, how the slider feels, what CLIP says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field import BakedField
from progdf.field.baked import SliderRemap
from progdf.field.choose import sample_strengths
from progdf.field.trajectory import Trajectory
from progdf.gaussians import Gaussians
from progdf.metrics.slider import Pictures, SliderStatistics, slider_statistics
from progdf.rasterize import alpha_weights, render
from progdf.terminal import format_count, group_digits
from trainer.fit.evaluate import Evaluator
from trainer.fit.fit import Fitted, choice_figures, field_figures, stored_numbers
from trainer.optimize.losses import Perceptual
from trainer.options import TextOptions
from trainer.setup import TrainingSetup
from trainer.views.view import View, render_view

from .clip import CLIP_MODEL, Clip, direction, load_clip, same_features


@dataclass(frozen=True)
class ErrorCurve:
    """Errors of pictures along the slider, over all held-out views."""

    s: tuple[float, ...]  # slider values, ascending
    psnr: tuple[float, ...]  # over the pixels that count, dB, at most 99
    seen_s: tuple[float, ...]  # those of them at which the others are taken, the last among them
    ssim: tuple[float, ...]  # over the same pixels, at most 1
    # of the views' boxes, ≥ 0 (or what stands in for LPIPS, see `Evaluator.perceptual`)
    lpips: tuple[float, ...]

    def to_json(self) -> dict[str, list[float]]:
        """As report.json and evaluation.json have it."""
        return {name: [round(x, 2 if name == "psnr" else 4) for x in xs] for name, xs in asdict(self).items()}


def picture_courses(
    evaluator: Evaluator,
    pictures: Mapping[str, Pictures],
    strengths: Sequence[float],
    truth: Pictures,
    perceptual: Perceptual,
    most: int | None = None,
) -> dict[str, ErrorCurve]:
    """The errors of whatever shows the held-out views, over the slider.

    Args:
        evaluator: the views
        pictures: by name: what is shown at a slider value. -> [h,w,3] each
        strengths: slider values, ascending
        truth: what the pictures should be at one of them. -> [h,w,3] each
        perceptual: LPIPS, or its stand-in
        most: about how many strengths SSIM and LPIPS are taken at, which cost far more; None: all
    """
    every = 1 if most is None else max(1, round(len(strengths) / most))
    seen = tuple(strengths[::-1][::every][::-1])
    psnr, rows = ({name: list[Any]() for name in pictures} for _ in range(2))
    for s in strengths:
        expected = truth(s)
        for name, picture_at in pictures.items():
            pictures_at = picture_at(s)
            psnr[name].append(evaluator.psnr(pictures_at, expected))
            if s in seen:
                ssim = evaluator.ssim(pictures_at, expected)
                rows[name].append((ssim, evaluator.perceptual(pictures_at, expected, perceptual, "measured")))
        perceptual.forget()
    return {
        name: ErrorCurve(tuple(strengths), tuple(psnr[name]), seen, *zip(*rows[name], strict=True))
        for name in pictures
    }


def against_editor(
    evaluator: Evaluator,
    fields: Mapping[str, BakedField],
    stages: Sequence[tuple[float, float]],
    perceptual: Perceptual,
    most: int | None = None,
) -> dict[str, ErrorCurve]:
    """Each field's errors against the editor's own pictures.

    Args:
        evaluator: held-out views with these pictures
        fields: by name
        stages: slider value and the strength that the editor was asked at, ascending
        perceptual: LPIPS, or its stand-in
        most: see `picture_courses`
    """
    pictures = {name: evaluator.course(field) for name, field in fields.items()}
    truth = {s: evaluator.edited[at] for s, at in stages}
    return picture_courses(evaluator, pictures, tuple(truth), truth.__getitem__, perceptual, most)


COMPARED = "keyframes2"
"""The baseline whose courses stand beside the field's: what anyone would do first."""

_ROUNDED = 1.5 / 255  # two images in 8 bits differ by as much
_ALIKE = 0.05  # of color, by which `changed` tells a painted pixel where it knows nothing of how it was saved
_NODES = 6  # recordings at which the field is looked at
CLIP_STRENGTHS = tuple(i / 10 for i in range(11))


@dataclass(frozen=True)
class Direction:
    """CLIP directional similarity along the slider."""

    s: tuple[float, ...] = ()  # slider values; none where nothing was measured
    # mean over held-out views, −1..1; None where it is undefined, as at 0
    similarity: tuple[float | None, ...] = ()
    model: str = ""  # the CLIP model, "" where nothing was measured
    reason: str = ""  # why nothing was measured, "" where it was


@dataclass(frozen=True)
class Measured:
    """Everything about the fitted field that the report tells, measured on held-out views.

    What concerns the edit is measured on all of them, the field's errors on those that it was not chosen on.
    """

    fitted: Fitted  # the field and its baselines, on the trajectory's slider
    shown: BakedField  # the field as it is shipped, on a slider of its own
    remap: SliderRemap  # from the trajectory's slider to that
    # slider value of what the editor was asked for, and the strength that it was asked at
    asked: Sequence[tuple[float, float]]
    slider: SliderStatistics  # how the slider feels
    at_recordings: float  # worst PSNR of the field at the recordings themselves, dB
    # "slider" and the compared baseline against the editor's own pictures, at the strengths it was asked for
    editor: Mapping[str, ErrorCurve]
    perceptual: str  # name of the perceptual distance
    clip: Direction  # see `Direction`


def measure(
    judges: tuple[Evaluator, Evaluator],
    trajectory: Trajectory,
    fitted: Fitted,
    shipped: BakedField,
    remap: SliderRemap,
    perceptual: Perceptual,
    clip: Direction,
) -> Measured:
    """Measure the chosen field beside the compared baseline.

    Args:
        judges: all held-out views, and those of them on which the field was not chosen
        trajectory: what was recorded
        fitted: the field and its baselines
        shipped: the field as it is shipped
        remap: from the trajectory's slider to the shipped field's
        perceptual: LPIPS, or its stand-in
        clip: measured already, or the reason why not
    """
    (evaluator, reporting), field = judges, fitted.chosen.field
    linear = fitted.baselines[COMPARED].field
    slider = slider_statistics(evaluator.course(shipped), masks=evaluator.pixels)
    stages = tuple((remap.at(s), strength) for s, strength in trajectory.stage_strengths)
    drawn = against_editor(evaluator, {"slider": shipped, COMPARED: linear}, stages, perceptual, most=1)
    nodes = trajectory.s[1:-1][:: max(1, -(-(len(trajectory) - 2) // _NODES))].tolist()
    worst = min(
        (
            reporting.psnr(reporting.pictures(field.offsets(s)), reporting.pictures(trajectory.at(s)))
            for s in nodes
        ),
        default=fitted.chosen.worst,
    )
    return Measured(
        fitted,
        shipped,
        remap,
        asked=stages,
        slider=slider,
        at_recordings=worst,
        editor=drawn,
        perceptual=perceptual.name,
        clip=clip,
    )


def expected_measures(trajectory: Trajectory) -> int:
    """About how often `measure` looks at its views, for a progress bar."""
    return 30 + 2 * len(trajectory.stage_strengths) + 2 * _NODES


def clip_curve(
    evaluator: Evaluator, views: Sequence[View], field: BakedField, texts: TextOptions
) -> Direction:
    """CLIP directional similarity of the whole held-out views, or the reason why it is not measured.

    Args:
        evaluator: held-out views
        views: the same, whole
        field: what the slider shows
        texts: see `TextOptions`
    """
    for text, option in ((texts.text_before, "--text-before"), (texts.text_after, "--text-after")):
        if not text.strip():
            return Direction(reason=f"{option} was not given: it takes a text for each end of the slider")
    try:
        clip = load_clip(CLIP_MODEL)
    except ProgdfError as error:
        return Direction(reason=str(error))
    before, after = clip.texts([texts.text_before, texts.text_after])
    if bool(same_features(before, after)):
        return Direction(reason="--text-before and --text-after say the same to CLIP")
    original = clip.pictures([view.image for view in views])
    course = [
        _mean(direction(original, _clip_features(clip, evaluator, views, field.offsets(s)), before, after))
        if s
        else None
        for s in CLIP_STRENGTHS
    ]
    return Direction(CLIP_STRENGTHS, tuple(course), clip.name)


def figures(measured: Measured, endpoint_error: float, outside_change: float) -> dict[str, Any]:
    """The part of report.json that depends on the field (see docs of the command line)."""
    fitted = measured.fitted
    slider = measured.slider
    drawn = measured.editor["slider"]
    linear = measured.editor[COMPARED]
    similarity = measured.clip.similarity
    return {
        "field": {
            **field_figures(fitted.chosen),
            "parameters": stored_numbers(measured.shown),
            "psnr_at_recordings": round(measured.at_recordings, 2),
            "endpoint_error": endpoint_error,
            "outside_change": outside_change,
            "target_met": fitted.choice.met,
        },
        "choice": choice_figures(fitted),
        "baselines": {name: field_figures(errors) for name, errors in fitted.baselines.items()},
        "slider": {
            "monotone": slider.monotone,
            "uniformity": round(slider.uniformity, 3),
            "largest_jump": round(slider.largest_jump, 5),
            "t50": round(slider.t50, 3),
            "t90": round(slider.t90, 3),
        },
        "between": {
            f"{round(s, 4):g}": {"psnr": round(ours, 2), COMPARED: round(plain, 2), "strength": strength}
            for (s, strength), ours, plain in zip(measured.asked, drawn.psnr, linear.psnr, strict=True)
            if s < 1.0
        },
        "edit": {
            "psnr_to_views": round(drawn.psnr[-1], 2),
            "ssim_to_views": _four(drawn.ssim[-1]),
            "lpips_to_views": _four(drawn.lpips[-1]),
            "perceptual": measured.perceptual,
            "clip_direction": similarity[-1] if similarity else None,
            **({"clip_model": measured.clip.model} if similarity else {"clip_reason": measured.clip.reason}),
        },
        "curves": {
            "against_trajectory": {
                "s": [_four(measured.remap.at(s)) for s in sample_strengths()],
                "slider": [round(psnr, 2) for psnr in fitted.chosen.curve],
                COMPARED: [round(psnr, 2) for psnr in fitted.baselines[COMPARED].curve],
            },
            "against_editor": {name: found.to_json() for name, found in measured.editor.items()},
            "change": {
                "from_original": [_four(distance) for distance in slider.distances],
                "per_step": [_four(step) for step in slider.steps],
            },
            "clip_direction": {"s": measured.clip.s, "similarity": similarity} if similarity else None,
        },
    }


def _clip_features(clip: Clip, evaluator: Evaluator, views: Sequence[View], offsets: Tensor) -> Tensor:
    """CLIP's features of the whole views with these offsets. [n,D]"""
    pictures = []
    for view, scene, picture in zip(views, evaluator.crops, evaluator.pictures(offsets), strict=True):
        x0, y0, x1, y1 = scene.box
        image = view.image.clone()
        image[y0:y1, x0:x1] = picture
        pictures.append(image)
    return clip.pictures(pictures)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return _four(sum(known) / len(known)) if known else None


def _four(value: float) -> float:
    return round(value, 4)


@dataclass(frozen=True)
class PaintTaken:
    """How much of what was painted on pictures is in the edit."""

    reached: float  # share of the painted change's energy, 0..1
    missing: float  # what of it is not there, of color, root of the mean square over the painted pixels
    pixels: int  # that were painted
    members: int  # that mostly show in these
    removes: bool  # whether most of the change's energy shows what lies behind the members

    @property
    def share(self) -> str:
        """How much it is, in a line."""
        return f"{100 * self.reached:.0f} % of what was painted is in the edit"

    @property
    def warning(self) -> str:
        """One line that says how little it is, and why; "" where it does not show, and nothing was removed.

        What is missing shows where it is as strong as a change that would be told from none, or, of a
        fainter one, the larger part of it.
        """
        shows = self.missing > _ALIKE or self.reached < 0.5
        if not self.pixels or not (shows or self.removes):
            return ""
        reasons = []
        if self.removes:
            reasons.append(
                "the painting covers things with what lies behind them: nothing is removed by painting "
                "(--removal always takes it away)"
            )
        if shows and self.members < self.pixels:
            stand = f"{format_count(self.members)} stand for {group_digits(self.pixels)} painted pixels"
            reasons.append(f"{stand}; the detail is finer than they are")
        return f"{self.share}: {'; '.join(reasons)}" if reasons else self.share

    def figures(self) -> dict[str, Any]:
        """What report.json says of it."""
        rounded = {"reached": _four(self.reached), "missing": _four(self.missing)}
        return {**asdict(self), **rounded, "warning": self.warning}


def measure_paint(
    setup: TrainingSetup, painted: Sequence[Tensor], backgrounds: Sequence[Tensor], edited: Gaussians
) -> PaintTaken:
    """Compare the edit with the pictures that it was made of.

    Args:
        setup: scene, region, and the pictures' views
        painted: the views as they were painted. [H,W,3] each
        backgrounds: what shows through the scene in each picture, rgb. [3] each
        edited: the scene with the edit, rows that it adds last
    """
    scene = setup.scene
    members = setup.region.members
    without = scene[~setup.region.mask]
    change = missing = behind = 0.0
    pixels = 0
    weights = torch.zeros(len(scene), 2, dtype=torch.float64)
    for view, target, background in zip(setup.train, painted, backgrounds, strict=True):
        energy = (target - view.image).square().sum(dim=2)
        # a JPEG is off by a little all over: elsewhere only what is painted for certain
        least = torch.where(view.mask > 0.5, _ROUNDED, _ALIKE)
        changed = (target - view.image).abs().amax(dim=2) > least
        made = render_view(edited, view.camera, setup.background).clamp(0.0, 1.0)
        change += float(energy[changed].sum())
        missing += float((target - made)[changed].square().sum())
        behind += float(energy[changed & _shows_behind(scene, without, view, target, background)].sum())
        pixels += int(changed.sum())
        weights += alpha_weights(scene, view.camera, changed)[:, (0, 2)]
    inside, weight = weights[members].unbind(1)
    visible = int((inside > 0.5 * weight).sum()) + len(edited) - len(scene)
    strength = (missing / max(1, 3 * pixels)) ** 0.5
    reached = max(0.0, 1.0 - missing / max(change, 1e-12))
    return PaintTaken(reached, strength, pixels, visible, behind > 0.5 * change)


def _shows_behind(
    scene: Gaussians, without: Gaussians, view: View, target: Tensor, background: Tensor
) -> Tensor:
    """Where a picture shows what lies behind the members, or its background in one piece with where nothing
    else was: what the members hid was painted away with them. [H,W] bool"""
    original, gone = (render_view(some, view.camera, background).clamp(0, 1) for some in (scene, without))
    picture = target + original - view.image  # over its own background
    bare = (picture - background).abs().amax(dim=2) < _ALIKE
    clear = render(scene, view.camera, (0.0, 0.0, 0.0)).transmittance > 0.5
    # a soft rim is a pixel wide on either side
    pieces, count = ndimage.label(ndimage.binary_dilation(bare.numpy(), np.ones((3, 3))))
    open_ = np.zeros(count + 1, dtype=bool)
    open_[pieces[(bare & clear).numpy()]] = True
    return bare & torch.from_numpy(open_[pieces]) | ((picture - gone).abs().amax(dim=2) < _ALIKE)
