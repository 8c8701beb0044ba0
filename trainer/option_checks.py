"""The options of `progdf train` and `progdf fit`, checked."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from progdf.errors import ProgdfError
from progdf.metrics.image import NO_DIFFERENCE
from trainer.options import (
    LARGEST_SEED,
    LONGEST_NAME,
    MOST_STAGES,
    MOST_STEPS,
    MOST_THREADS,
    NETWORK_OPTIONS,
    QUICK_STAGES,
    QUICK_STEPS,
    QUICK_VIEWS,
    SMALLEST_VIEW,
    VIEWS,
    FitOptions,
    TrainOptions,
)


def resolve_options(options: TrainOptions) -> TrainOptions:
    """The options with `quick` and the name worked in, and checked.

    Raises:
        ProgdfError: a number that makes no sense.
    """
    if options.quick:
        options = replace(
            options,
            steps=min(options.steps, QUICK_STEPS),
            stages=min(options.stages, QUICK_STAGES),
            views=min(options.views or QUICK_VIEWS, QUICK_VIEWS),
        )
    name = check_name(options.name or options.out.resolve().name)
    check_ranges(
        ("--views", options.views or VIEWS, 3, 96),
        ("--image-size", options.image_size or SMALLEST_VIEW, SMALLEST_VIEW, 2048),
        ("--stages", options.stages, 0, 16),
        ("--group-steps", options.group_steps, 0, 10_000),
        ("--seed", options.seed, 0, LARGEST_SEED),
        ("--threads", options.threads, 0, MOST_THREADS),
        ("--guidance", options.guidance, 1, 100),
        ("--image-guidance", options.image_guidance, 1, 100),
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
    if not 0 <= options.save_every < math.inf:
        raise ProgdfError(f"--save-every must be 0 or more seconds, got {options.save_every}")
    _check_editor_options(options)
    check_network_options(options)
    return replace(options, name=name)


def check_name(name: str) -> str:
    """The name of a layer and its file, if it can be one.

    Raises:
        ProgdfError: it cannot.
    """
    if not name or name.startswith(".") or not name.isprintable() or {"/", "\\"} & set(name):
        raise ProgdfError(
            f"'{name}' is not a valid layer name; choose one with --name, for example --name shirt"
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
    of_instruct = ("model", "guidance", "image_guidance", "edit_steps")
    of_painters = ("edit_size", "reedit_every")
    for names, kinds in ((of_instruct, ("instruct",)), (of_painters, ("style", "instruct"))):
        for name in names:
            said = getattr(options, name) != getattr(TrainOptions, name)
            if said and kind not in kinds:
                option = "--" + name.replace("_", "-")
                raise ProgdfError(f"{option} does not apply to {kind}; it is for {' and '.join(kinds)}")


def check_network_options(options: TrainOptions | FitOptions) -> None:
    """Options of the field that make sense, and those of a network only where there is one.

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
        if options.field != "neural" and getattr(options, name, default) != default:
            raise ProgdfError(f"{option} does not apply to --field {options.field}; add --field neural")
    if options.bytes_budget is not None:
        if options.field in ("neural", "lossless"):
            raise ProgdfError(f"--bytes-budget does not apply to --field {options.field}; leave one out")
        if not 1 <= options.bytes_budget < math.inf:
            raise ProgdfError(f"--bytes-budget must be at least 1 byte, got {options.bytes_budget:g}")
    if not 0 <= options.code <= 64:
        raise ProgdfError(f"--code must be between 0 and 64, got {options.code}")
    if not 0 <= options.picture_loss < math.inf:
        raise ProgdfError(f"--picture-loss must be 0 or more, got {options.picture_loss}")


def plain_options(options: TrainOptions) -> dict[str, Any]:
    """The options that the result depends on or came from, as JSON values."""
    return {
        name: str(v) if isinstance(v, Path) else v
        for name, v in asdict(options).items()
        if name not in ("resume", "save_every")
    }
