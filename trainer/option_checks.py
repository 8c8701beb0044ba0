"""The options of `progdf train` and `progdf fit`, checked."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from progdf.errors import ProgdfError
from progdf.io.atomic import is_portable
from progdf.metrics.image import NO_DIFFERENCE
from trainer.options import (
    LARGEST_SEED,
    LONGEST_NAME,
    MOST_STAGES,
    MOST_STEPS,
    MOST_THREADS,
    NETWORK_OPTIONS,
    SMALLEST_VIEW,
    VIEWS,
    FitOptions,
    TrainOptions,
)
from trainer.presets import PRESETS


def check_options(options: TrainOptions) -> None:
    """Refuse what makes no sense, and what would be passed over in silence.

    Raises:
        ProgdfError: a number out of its range, or an option that the editor or the field does not know.
    """
    check_ranges(
        ("--views", options.views or VIEWS, 3, 96),
        ("--image-size", options.image_size or SMALLEST_VIEW, SMALLEST_VIEW, 2048),
        ("--stages", options.stages, 0, 16),
        ("--group-steps", options.group_steps, 0, 10_000),
        ("--seed", options.seed, 0, LARGEST_SEED),
        ("--threads", options.threads, 0, MOST_THREADS),
        ("--edit-steps", options.edit_steps, 1, 1000),
        ("--edit-size", options.edit_size, 32, 4096),
        ("--lift-threshold", options.lift_threshold, 0, 1),
        ("--box-threshold", options.box_threshold, 0, 1),
        ("--reedit-every", options.reedit_every, 0, 100_000),
    )
    stages = options.stages or MOST_STAGES
    if not 4 * stages <= options.steps <= MOST_STEPS:
        raise ProgdfError(
            f"--steps must be between {4 * stages} and {MOST_STEPS} for {stages} stages, got {options.steps}"
        )
    weight = options.perceptual_weight
    if weight is not None and not 0 <= weight < math.inf:
        raise ProgdfError(f"--perceptual-weight must be 0 or more, got {weight}")
    lifts = options.lift_rule == "paper" and re.search(r"(masks|text):", options.region)
    if lifts and (options.lift_threshold is None or options.lift_threshold >= 0.8):
        raise ProgdfError(
            "--lift-rule paper selects nothing at the printed .8: the mean weight of a splat in its pixels "
            "is a fifth at most; give --lift-rule share, or --lift-threshold .01"
        )
    _check_editor_options(options)
    check_network_options(options, PRESETS[options.preset])


def guidance_of(text: str) -> tuple[float | None, float | None]:
    """What --guidance says of the sentence and of the picture; None where it says nothing.

    Raises:
        ProgdfError: it is neither one number nor two.
    """
    words = text.split(",") if text else []
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [math.nan]
    if len(numbers) > 2 or not all(1 <= number <= 100 for number in numbers):
        raise ProgdfError(
            f"--guidance must be one or two numbers between 1 and 100, such as 7.5,1.5; got {text}"
        )
    sentence, picture = (*numbers, None, None)[:2]
    return sentence, picture


def check_name(name: str) -> str:
    """The name of a layer and its file, if it can be one.

    Raises:
        ProgdfError: it cannot.
    """
    if not name or name.startswith(".") or not name.isprintable() or {"/", "\\"} & set(name):
        raise ProgdfError(
            f"'{name}' is not a valid layer name; choose one with --name, for example --name shirt"
        )
    if not is_portable(name):
        raise ProgdfError(
            f"'{name}' is not a valid layer name, as Windows cannot have a file of that name; "
            "choose one with --name, for example --name shirt"
        )
    if len(f"{name}.gdf".encode()) > LONGEST_NAME:
        raise ProgdfError(f"the name '{name[:20]}…' is too long for a file; choose another one with --name")
    return name


def check_ranges(*ranges: tuple[str, float | None, float, float]) -> None:
    """Raises ProgdfError at the first value outside its range.

    Args:
        ranges: the option, its value or None where it has none, the least and the largest that is right
    """
    for what, value, low, high in ranges:
        if value is not None and not low <= value <= high:
            raise ProgdfError(f"{what} must be between {low} and {high}, got {value}")


def _check_editor_options(options: TrainOptions) -> None:
    """No option is passed over in silence: one that the editor does not know is refused."""
    kind = options.editor.partition(":")[0]
    if kind == "pictures" and options.kind not in ("auto", "color"):
        raise ProgdfError(
            f"--kind {options.kind} does not apply to pictures: few views do not tell how deep a part lies; "
            "give more as folder:DIR, of views that --cameras has"
        )
    of_instruct = ("model", "guidance", "edit_steps")
    of_painters = ("edit_size", "reedit_every")
    for names, kinds in ((of_instruct, ("instruct",)), (of_painters, ("style", "instruct"))):
        for name in names:
            said = getattr(options, name) != getattr(TrainOptions, name)
            if said and kind not in kinds:
                option = "--" + name.replace("_", "-")
                raise ProgdfError(f"{option} does not apply to {kind}; it is for {' and '.join(kinds)}")


def check_network_options(
    options: TrainOptions | FitOptions, preset: Mapping[str, object] = PRESETS["default"]
) -> None:
    """Options of the field that make sense, and those of a network only where there is one, or by a preset.

    Raises:
        ProgdfError: one does not.
    """
    if not 0 < options.target_psnr <= NO_DIFFERENCE:
        raise ProgdfError(
            f"--target-psnr must be above 0 and at most {NO_DIFFERENCE:g} dB, which stands for no "
            f"difference, got {options.target_psnr:g}"
        )
    for name, default in NETWORK_OPTIONS.items():
        option = "--" + name.replace("_", "-")
        if options.field != "neural" and getattr(options, name) not in (default, preset.get(name)):
            raise ProgdfError(f"{option} does not apply to --field {options.field}; add --field neural")
    if options.bytes_budget is not None:
        if options.field in ("neural", "lossless"):
            raise ProgdfError(f"--bytes-budget does not apply to --field {options.field}; leave one out")
        if not 1 <= options.bytes_budget < math.inf:
            raise ProgdfError(f"--bytes-budget must be at least 1 byte, got {options.bytes_budget:g}")
