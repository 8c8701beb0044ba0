"""Errors of fields along the slider, on held-out views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from progdf.field import BakedField
from progdf.metrics.slider import Pictures
from trainer.fit.evaluate import Evaluator
from trainer.optimize.losses import Perceptual


@dataclass(frozen=True)
class ErrorCurve:
    """Errors of pictures along the slider, over all held-out views.

    Args:
        s: slider values, ascending
        psnr: over the pixels that count, dB, at most 99
        ssim: over the same, at most 1
        lpips: of the views' boxes, ≥ 0 (or what stands in for LPIPS, see `Evaluator.perceptual`)
    """

    s: tuple[float, ...]
    psnr: tuple[float, ...]
    ssim: tuple[float, ...]
    lpips: tuple[float, ...]


def error_curves(
    evaluator: Evaluator,
    fields: Mapping[str, BakedField],
    strengths: Sequence[float],
    truth: Pictures,
    perceptual: Perceptual,
) -> dict[str, ErrorCurve]:
    """Each field's errors on held-out views, over the slider; see `picture_courses`."""

    def shown(field: BakedField) -> Pictures:
        return lambda s: evaluator.pictures(field.offsets(s))

    pictures = {name: shown(field) for name, field in fields.items()}
    return picture_courses(evaluator, pictures, strengths, truth, perceptual)


def picture_courses(
    evaluator: Evaluator,
    pictures: Mapping[str, Pictures],
    strengths: Sequence[float],
    truth: Pictures,
    perceptual: Perceptual,
) -> dict[str, ErrorCurve]:
    """The errors of whatever shows the held-out views, over the slider.

    Args:
        evaluator: the views
        pictures: by name: what is shown at a slider value. -> [h,w,3] each
        strengths: slider values, ascending
        truth: what the pictures should be at one of them. -> [h,w,3] each
        perceptual: LPIPS, or its stand-in
    """
    rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in pictures}
    for s in strengths:
        expected = truth(s)
        for name, shown in pictures.items():
            found = shown(s)
            rows[name].append(
                (
                    evaluator.psnr(found, expected),
                    evaluator.ssim(found, expected),
                    evaluator.perceptual(found, expected, perceptual, "measured"),
                )
            )
        perceptual.forget()
    return {
        name: ErrorCurve(tuple(strengths), *(tuple(row[i] for row in found) for i in range(3)))
        for name, found in rows.items()
    }


def against_editor(
    evaluator: Evaluator,
    fields: Mapping[str, BakedField],
    asked: Sequence[tuple[float, float]],
    perceptual: Perceptual,
) -> dict[str, ErrorCurve]:
    """Each field's errors against the editor's own pictures.

    Args:
        evaluator: held-out views with these pictures
        fields: by name
        asked: slider value and the strength that the editor was asked at, ascending
        perceptual: LPIPS, or its stand-in
    """
    strength = dict(asked)
    return error_curves(
        evaluator, fields, tuple(strength), lambda s: evaluator.edited[strength[s]], perceptual
    )
