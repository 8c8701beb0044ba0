"""Quality measures of a run: errors over the slider on held-out views, slider uniformity, CLIP similarity."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError
from progdf.field import BakedField
from progdf.field.choose import Field, sample_strengths
from progdf.field.trajectory import Trajectory
from progdf.gaussians import ATTRIBUTES, BASE_CHANNELS, Gaussians, pack
from progdf.gdf.file import Gdf
from progdf.metrics.image import decibels
from progdf.metrics.slider import Pictures, SliderStatistics, slider_statistics
from progdf.rasterize import alpha_weights, render
from progdf.terminal import format_count, group_digits
from trainer.editors.pictures import picture_background, read_edit
from trainer.fit.delivered import DeliveredEdit
from trainer.fit.evaluate import Evaluator
from trainer.fit.fit import Fitted, choice_figures, field_figures, stored_numbers
from trainer.fit.keyframes import TwoKeyframes, closest_keyframes
from trainer.optimize.carry_on import draw_behind
from trainer.optimize.losses import Perceptual
from trainer.options import TextOptions
from trainer.views.setup import TrainingSetup
from trainer.views.view import View, render_view

from .clip import CLIP_MODEL, Clip, direction, load_clip, same_features

_PAINTED_COLOR = 2 / 255  # smallest color difference that counts as paint


@dataclass(frozen=True)
class ErrorCurve:
    """Errors of pictures along the slider, over all held-out views."""

    s: tuple[float, ...]  # slider values, ascending
    psnr: tuple[float, ...]  # over the evaluated pixels, dB, at most 99
    # slider values of `ssim` and `lpips`, a subset of `s` with the last one; empty if not measured
    seen_s: tuple[float, ...]
    ssim: tuple[float, ...]  # over the same pixels, at most 1
    # over the views' boxes, ≥ 0 (LPIPS or its substitute, see `Evaluator.perceptual`)
    lpips: tuple[float, ...]

    def to_json(self) -> dict[str, list[float]]:
        """Return the curve for report.json and evaluation.json."""
        return {name: [round(x, 2 if name == "psnr" else 4) for x in xs] for name, xs in asdict(self).items()}


def error_curves(
    evaluator: Evaluator,
    pictures: Mapping[str, Pictures],
    strengths: Sequence[float],
    truth: Pictures,
    perceptual: Perceptual | None,
    most: int | None = None,
) -> dict[str, ErrorCurve]:
    """Measure errors of several sources of held-out pictures over the slider.

    Args:
        evaluator: the views
        pictures: by name, a function from slider value to pictures. -> [h,w,3] each
        strengths: slider values, ascending
        truth: function from slider value to the expected pictures. -> [h,w,3] each
        perceptual: LPIPS or its substitute; None: measure neither SSIM nor LPIPS
        most: approximate number of slider values for SSIM and LPIPS, which cost far more; None: all
    """
    every = 1 if most is None else max(1, round(len(strengths) / most))
    seen = tuple(strengths[::-1][::every][::-1]) if perceptual is not None else ()
    psnr, ssim, lpips = ({name: list[float]() for name in pictures} for _ in range(3))
    for s in strengths:
        expected = truth(s)
        for name, picture_at in pictures.items():
            pictures_at = picture_at(s)
            psnr[name].append(evaluator.psnr(pictures_at, expected))
            if perceptual is not None and s in seen:
                ssim[name].append(evaluator.ssim(pictures_at, expected))
                lpips[name].append(evaluator.perceptual(pictures_at, expected, perceptual, "measured"))
        if perceptual is not None:
            perceptual.forget()
    return {
        name: ErrorCurve(tuple(strengths), tuple(psnr[name]), seen, tuple(ssim[name]), tuple(lpips[name]))
        for name in pictures
    }


def against_editor(
    evaluator: Evaluator,
    fields: Mapping[str, Field],
    stages: Sequence[tuple[float, float]],
    perceptual: Perceptual | None,
    most: int | None = None,
) -> dict[str, ErrorCurve]:
    """Measure each field's errors against the editor's pictures.

    Args:
        evaluator: held-out views with these pictures
        fields: by name
        stages: slider value and the editor strength that belongs to it, ascending
        perceptual: see `error_curves`
        most: see `error_curves`
    """
    pictures = {name: evaluator.course(field) for name, field in fields.items()}
    truth = {s: evaluator.edited[at] for s, at in stages}
    return error_curves(evaluator, pictures, tuple(truth), truth.__getitem__, perceptual, most)


COMPARED = "keyframes2"
"""Baseline whose curves are shown beside the field's, see `closest_keyframes`."""

_ROUNDING_DIFFERENCE = 1.5 / 255  # color difference of two images due to rounding to 8 bits
REPRODUCED_SHARE = 0.9
"""Share of the paint, 0 to 1, from which an edit of pictures counts as a success."""
_PAINT_DIFFERENCE = 0.05  # color difference of a painted pixel if the file format is unknown, as in `changed`
_COMPARED_ROWS = 1 << 16  # Gaussians that are compared at once, to copy little of a large scene
_RECORDING_SAMPLES = 6  # recordings at which the field is compared
CLIP_STRENGTHS = tuple(i / 10 for i in range(11))  # slider values of the CLIP curve


@dataclass(frozen=True)
class Direction:
    """CLIP directional similarity along the slider."""

    s: tuple[float, ...] = ()  # slider values; empty if not measured
    # mean over held-out views, −1 to 1; None if undefined, as at 0
    similarity: tuple[float | None, ...] = ()
    model: str = ""  # name of the CLIP model, "" if not measured
    reason: str = ""  # reason if not measured, else ""


@dataclass(frozen=True)
class Measured:
    """Measurements of the fitted field for the report, on held-out views.

    Figures of the edit use all held-out views; errors of the field use those that it was not chosen on.
    """

    edit: DeliveredEdit
    shown: BakedField  # the shipped field, with the discs for fine paint if there are any
    keyframes: TwoKeyframes  # the baseline `COMPARED`
    # PSNR of these at `sample_strengths()` of the trajectory against the recordings, dB
    keyframes_curve: Sequence[float]
    # slider value and strength of each set of editor pictures
    asked: Sequence[tuple[float, float]]
    slider: SliderStatistics  # uniformity and monotonicity of the slider
    at_recordings: float  # worst PSNR of the field at the recordings, dB
    # "slider" and the compared baseline against the editor's pictures, at the editor's strengths
    editor: Mapping[str, ErrorCurve]
    edge_psnr: float  # PSNR of the full edit at the edges of the editor's pictures, dB
    perceptual: str  # name of the perceptual distance, "" if not measured
    clip: Direction  # see `Direction`


def measure(
    judges: tuple[Evaluator, Evaluator],
    setup: TrainingSetup,
    edit: DeliveredEdit,
    is_even: bool,
    perceptual: Perceptual | None,
    clip: Direction,
) -> Measured:
    """Measure the chosen field beside the compared baseline.

    Args:
        judges: evaluators of all held-out views, and of those on which the field was not chosen
        setup: training views, with the Gaussians that the edit adds
        edit: the edit as delivered
        is_even: True if equal steps of the slider change the pictures equally
        perceptual: see `error_curves`
        clip: finished CLIP measurement, or the reason if there is none
    """
    evaluator, reporting = judges
    trajectory = edit.trajectory
    shipped = edit.gdf.field
    remap = edit.remap
    slider = slider_statistics(evaluator.course(shipped), masks=evaluator.pixels)
    stages = tuple((remap.at(s), strength) for s, strength in trajectory.stage_strengths)
    keyframes = closest_keyframes(shipped, setup, evaluator, stages, is_even)
    drawn = against_editor(evaluator, {"slider": shipped, COMPARED: keyframes}, stages, perceptual, most=1)

    def recorded_psnr(field: Field, s: float) -> float:
        return reporting.psnr(
            reporting.pictures(field.offsets(remap.at(s))), reporting.pictures(trajectory.at(s))
        )

    nodes = trajectory.s[1:-1][:: max(1, -(-(len(trajectory) - 2) // _RECORDING_SAMPLES))].tolist()
    worst = min((recorded_psnr(shipped, s) for s in nodes), default=edit.chosen.worst)
    return Measured(
        edit,
        shipped,
        keyframes,
        keyframes_curve=[recorded_psnr(keyframes, s) for s in sample_strengths()],
        asked=stages,
        slider=slider,
        at_recordings=worst,
        editor=drawn,
        edge_psnr=evaluator.edge_psnr(evaluator.course(shipped)(1.0), evaluator.edited[stages[-1][1]]),
        perceptual="" if perceptual is None else perceptual.name,
        clip=clip,
    )


def expected_measures(trajectory: Trajectory) -> int:
    """Return the approximate number of renders of all views by `measure`, for a progress bar."""
    samples = _RECORDING_SAMPLES + len(sample_strengths())
    return 30 + 4 * len(trajectory.stage_strengths) + 2 * samples


def clip_curve(
    evaluator: Evaluator, views: Sequence[View], field: BakedField, texts: TextOptions
) -> Direction:
    """Measure the CLIP directional similarity of the whole held-out views; return the reason if it fails.

    Args:
        evaluator: held-out views
        views: the same views, uncropped
        field: the field of the slider
        texts: see `TextOptions`
    """
    for text, option in ((texts.text_before, "--text-before"), (texts.text_after, "--text-after")):
        if not text.strip():
            return Direction(reason=f"{option} is missing; CLIP needs a text for each end of the slider")
    try:
        clip = load_clip(CLIP_MODEL)
    except ProgdfError as error:
        return Direction(reason=str(error))
    before, after = clip.texts([texts.text_before, texts.text_after])
    if bool(same_features(before, after)):
        return Direction(reason="CLIP has the same features for --text-before and --text-after")
    original = clip.pictures([view.image for view in views])
    similarity = [
        _mean(direction(original, _clip_features(clip, evaluator, views, field.offsets(s)), before, after))
        if s
        else None
        for s in CLIP_STRENGTHS
    ]
    return Direction(CLIP_STRENGTHS, tuple(similarity), clip.name)


def exactness(scene: Gaussians, gdf: Gdf, end: Tensor) -> tuple[float, float]:
    """Return the largest difference of the edit at s = 1 from the recorded end, and outside the region.

    Both are differences of raw parameters. The second is the change of Gaussians that must not change.
    """
    outside = ~gdf.region.mask
    finished = edited_scene(scene, gdf)
    members = torch.cat([gdf.region.members, torch.arange(len(scene), len(finished))])
    packed = pack(finished[members], with_shN=end.shape[1] > BASE_CHANNELS)
    endpoint = float((packed - end).abs().max())
    change = _largest_change(scene, finished, outside)
    del finished  # one copy of a large scene at a time
    change = max(change, _largest_change(scene, edited_scene(scene, gdf, 0.3), outside))
    return endpoint, change


def _largest_change(scene: Gaussians, edited: Gaussians, counted: Tensor) -> float:
    """Return the largest difference of raw parameters, over the counted rows of the scene. [N] bool"""
    largest = 0.0
    for name in ATTRIBUTES:
        before, after = getattr(scene, name), getattr(edited, name)
        for begin in range(0, len(scene), _COMPARED_ROWS):
            rows = slice(begin, min(begin + _COMPARED_ROWS, len(scene)))
            difference = (after[rows] - before[rows])[counted[rows]]
            if difference.numel():
                largest = max(largest, float(difference.abs().max()))
    return largest


def delivered_figures(
    fitted: Fitted, shown: BakedField, endpoint_error: float, outside_change: float, psnr: float
) -> dict[str, Any]:
    """Return the part of report.json that is known when the edit's file is written.

    Args:
        fitted: the field and its baselines
        shown: the shipped field
        endpoint_error, outside_change: see `exactness`
        psnr: PSNR of the full edit against the editor's pictures on held-out views, dB
    """
    return {
        "field": {
            **field_figures(fitted.chosen),
            "parameters": stored_numbers(shown),
            "endpoint_error": endpoint_error,
            "outside_change": outside_change,
            "target_met": fitted.choice.met,
        },
        "choice": choice_figures(fitted),
        "baselines": {name: field_figures(errors) for name, errors in fitted.baselines.items()},
        "edit": {"psnr_to_views": round(psnr, 2)},
    }


def measured_figures(measured: Measured) -> dict[str, Any]:
    """Return the part of report.json that is measured after the edit's file is written."""
    delivered = measured.edit
    slider = measured.slider
    drawn = measured.editor["slider"]
    linear = measured.editor[COMPARED]
    similarity = measured.clip.similarity
    edit: dict[str, Any] = {"edge_psnr_to_views": round(measured.edge_psnr, 2)}
    if measured.perceptual:
        edit["ssim_to_views"] = _round4(drawn.ssim[-1])
        edit["lpips_to_views"] = _round4(drawn.lpips[-1])
        edit["perceptual"] = measured.perceptual
    edit["clip_direction"] = similarity[-1] if similarity else None
    if similarity:
        edit["clip_model"] = measured.clip.model
    else:
        edit["clip_reason"] = measured.clip.reason
    keyframes = measured.keyframes
    curve = measured.keyframes_curve
    return {
        "field": {"psnr_at_recordings": round(measured.at_recordings, 2)},
        "baselines": {
            COMPARED: {
                "kind": "oklab" if keyframes.in_oklab else "raw",
                "bytes_per_gaussian": round(keyframes.bytes_per_member, 1),
                "psnr_mean": round(sum(curve) / len(curve), 2),
                "psnr_worst": round(min(curve), 2),
            }
        },
        "edit": edit,
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
        "curves": {
            "against_trajectory": {
                "s": [_round4(delivered.remap.at(s)) for s in sample_strengths()],
                "slider": [round(psnr, 2) for psnr in delivered.chosen.curve],
                COMPARED: [round(psnr, 2) for psnr in measured.keyframes_curve],
            },
            "against_editor": {name: found.to_json() for name, found in measured.editor.items()},
            "change": {
                "from_original": [_round4(distance) for distance in slider.distances],
                "per_step": [_round4(step) for step in slider.steps],
            },
            "clip_direction": {"s": measured.clip.s, "similarity": similarity} if similarity else None,
        },
    }


def _clip_features(clip: Clip, evaluator: Evaluator, views: Sequence[View], offsets: Tensor) -> Tensor:
    """Compute CLIP features of the whole views with these offsets. [n,D]"""
    pictures = []
    for view, scene, picture in zip(views, evaluator.crops, evaluator.pictures(offsets), strict=True):
        x0, y0, x1, y1 = scene.box
        image = view.image.clone()
        image[y0:y1, x0:x1] = picture
        pictures.append(image)
    return clip.pictures(pictures)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return _round4(sum(known) / len(known)) if known else None


def _round4(value: float) -> float:
    return round(value, 4)


@dataclass(frozen=True)
class PaintReproduction:
    """Share of the paint on the pictures that the edit reproduces."""

    reached: float  # reproduced share of the painted change's energy, 0 to 1
    missing: float  # RMS color difference between painting and edit over the painted pixels
    pixels: int  # number of painted pixels
    members: int  # number of members visible mostly in these pixels
    removes: bool  # True if most of the change's energy shows the scene behind the members

    @property
    def share(self) -> str:
        """One-line summary of the reproduced share."""
        return f"{100 * self.reached:.0f} % of the paint was reproduced"

    @property
    def warning(self) -> str:
        """`summary` if less than `REPRODUCED_SHARE` was reproduced or the paint removes something, else "".

        A loss that is not visible is no reason for a warning.
        """
        is_short = self._is_visible and self.reached < REPRODUCED_SHARE
        return self.summary if self.pixels and (is_short or self.removes) else ""

    @property
    def summary(self) -> str:
        """One line with the share and the reasons of a visible loss."""
        is_visible = self._is_visible
        reasons = []
        if self.removes:
            reasons.append(
                "the paint shows the background in place of an object, but painting removes nothing "
                "(use --removal always)"
            )
        if is_visible and self.members < self.pixels:
            counts = f"{format_count(self.members)} for {group_digits(self.pixels)} painted pixels"
            reasons.append(f"{counts}; the detail is finer than the Gaussians")
        return f"{self.share}: {'; '.join(reasons)}" if reasons else self.share

    @property
    def _is_visible(self) -> bool:
        """True if the loss is as strong as the smallest detectable change, or half of a fainter change."""
        return self.missing > _PAINT_DIFFERENCE or self.reached < 0.5

    def figures(self) -> dict[str, Any]:
        """Return the figures for report.json."""
        rounded = {"reached": _round4(self.reached), "missing": _round4(self.missing)}
        return {**asdict(self), **rounded, "summary": self.summary, "warning": self.warning}


def measure_paint(
    setup: TrainingSetup, painted: Sequence[Tensor], backgrounds: Sequence[Tensor], edited: Gaussians
) -> PaintReproduction:
    """Compare the edit with the painted pictures that it was made from.

    Args:
        setup: scene, region, and the pictures' views
        painted: painted pictures of the views. [H,W,3] each
        backgrounds: background color of each picture, rgb. [3] each
        edited: the scene with the edit; added rows come last
    """
    scene = setup.scene
    members = setup.region.members
    without = scene[~setup.region.mask]
    change = missing = behind = 0.0
    pixels = 0
    weights = torch.zeros(len(scene), 2, dtype=torch.float64)
    for view, target, background in zip(setup.train, painted, backgrounds, strict=True):
        energy = (target - view.image).square().sum(dim=2)
        # JPEG changes every pixel a little, so outside the region only clearly painted pixels count
        min_difference = torch.where(view.mask > 0.5, _ROUNDING_DIFFERENCE, _PAINT_DIFFERENCE)
        changed = (target - view.image).abs().amax(dim=2) > min_difference
        rendered = render_view(edited, view.camera, setup.background).clamp(0.0, 1.0)
        change += float(energy[changed].sum())
        missing += float((target - rendered)[changed].square().sum())
        behind += float(energy[changed & _shows_behind(scene, without, view, target, background)].sum())
        pixels += int(changed.sum())
        weights += alpha_weights(scene, view.camera, changed)[:, (0, 2)]
    inside, weight = weights[members].unbind(1)
    visible_count = int((inside > 0.5 * weight).sum()) + len(edited) - len(scene)
    rms = (missing / max(1, 3 * pixels)) ** 0.5
    reached = max(0.0, 1.0 - missing / max(change, 1e-12))
    return PaintReproduction(reached, rms, pixels, visible_count, behind > 0.5 * change)


def picture_backgrounds(setup: TrainingSetup, files: Sequence[Path]) -> list[Tensor]:
    """Return the background color of each changed picture; the setup's if the file was deleted. [3] each"""
    return [
        picture_background(setup.scene, file, view.camera) if file.is_file() else setup.background
        for file, view in zip(files, setup.train, strict=True)
    ]


def _shows_behind(
    scene: Gaussians, without: Gaussians, view: View, target: Tensor, background: Tensor
) -> Tensor:
    """Return the pixels in which a picture shows the scene behind the members. [H,W] bool

    Background pixels count only if they are connected to pixels that were background before.
    """
    original, removed = (render_view(some, view.camera, background).clamp(0, 1) for some in (scene, without))
    picture = target + original - view.image  # over its own background
    bare = (picture - background).abs().amax(dim=2) < _PAINT_DIFFERENCE
    clear = render(scene, view.camera, (0.0, 0.0, 0.0)).transmittance > 0.5
    # a soft boundary is a pixel wide on either side
    pieces, count = ndimage.label(ndimage.binary_dilation(bare.numpy(), np.ones((3, 3))))
    open_ = np.zeros(count + 1, dtype=bool)
    open_[pieces[(bare & clear).numpy()]] = True
    return bare & torch.from_numpy(open_[pieces]) | (
        (picture - removed).abs().amax(dim=2) < _PAINT_DIFFERENCE
    )


def measure_above(
    setup: TrainingSetup, gdf: Gdf, files: Sequence[Path], say: Callable[[str], None]
) -> dict[str, Any]:
    """Measure an edit above the layers that its pictures show; return the figures for report.json.

    Args:
        setup: views of the pictures, in their order
        gdf: edit of the original
        files: the pictures
        say: receives the result as a log line
    """
    lower = setup.lower
    if lower is None:
        return {}
    edited = lower.compose(gdf)
    errors = {"painted": 0.0, "rest": 0.0}
    counts = {"painted": 0, "rest": 0}
    for view, file in zip(setup.train, files, strict=True):
        before = render_view(lower.seen, view.camera, setup.background).clamp(0.0, 1.0)
        target = read_edit(lower.seen, view.camera, before, file)
        image = render_view(edited, view.camera, setup.background).clamp(0.0, 1.0)
        painted = (target - before).abs().amax(dim=2) > _PAINTED_COLOR
        for name, pixels in (("painted", painted), ("rest", ~painted)):
            errors[name] += float((image - target)[pixels].double().square().sum())
            counts[name] += 3 * int(pixels.sum())
    found = {name: round(decibels(error / max(1, counts[name])), 2) for name, error in errors.items()}
    say(
        f"above {lower.layers} (blend {lower.layers.blend}): {found['painted']} dB where the "
        f"picture is painted, {found['rest']} dB elsewhere"
    )
    strengths = {layer.name: layer.strength for layer in lower.layers.layers}
    return {"lower_layers": {"strengths": strengths, "blend": lower.layers.blend, "psnr": found}}


def carry_figures(
    setup: TrainingSetup, trajectory: Trajectory, effort: Mapping[str, Any], behind: Path
) -> dict[str, Any]:
    """Return the decision on parts that no picture shows, see `CarryDecision`, for report.json.

    If the color map may be carried on but is not, write a picture of it from behind.

    Args:
        setup: scene, region and the views of the pictures
        trajectory: the recordings, with their color maps
        effort: figures of the training
        behind: file of the picture
    """
    behind.unlink(missing_ok=True)
    decision = effort.get("carry_on")
    if decision is None:
        return {}
    degree = effort["degree"]
    if decision["offered"] and degree and trajectory.maps is not None:
        draw_behind(setup, trajectory.maps[-1], degree, behind)
    return {"carry_on": decision}
