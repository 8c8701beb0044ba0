"""The command `progdf evaluate --suite sliders FOLDER`: compare methods on edits with known pictures."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.demo_scenes import DemoScene
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.atomic import make_folder
from progdf.io.images import write_image
from progdf.metrics.slider import Pictures
from progdf.terminal import print_line
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.options import EvaluateOptions, check_ranges
from trainer.resolve import prepare_process
from trainer.store.run_folder import write_json

from .edits import STRENGTHS, SUITES, EditTask, KnownEdit, KnownTruth, Suite, make_task
from .methods import Slider, SliderMethod, find_methods
from .results import (
    FADE,
    MEASURES,
    SHOWN_STRENGTHS,
    EditResult,
    edit_rows,
    format_rows,
    suite_json,
    suite_picture,
    summary_rows,
)
from .scenes import load_suite_scene


def evaluate_suite(options: EvaluateOptions) -> list[EditResult]:
    """Run the suite, write FOLDER/sliders.json and sliders.png, and print two tables.

    Raises:
        ProgdfError: an option does not fit, a method is unknown or fails, or the folder cannot be written to.
    """
    suite = SUITES[options.suite or "sliders"]
    methods = find_methods(options.methods or suite.methods)
    check_ranges(("--seed", options.seed, 0, 2**32 - 1))
    perceptual, warning = perceptual_loss()
    if warning:
        print_line(warning.replace("training with", "measuring with"))
    results = run_suite(options.run, methods, perceptual, options.seed, options.threads, _print_result, suite)
    print_line("")
    for rows in (edit_rows(results), summary_rows(results, perceptual.name)):
        for line in (*format_rows(rows).splitlines(), ""):
            print_line(line)
    print_line(f"wrote {options.run / 'sliders.json'} and sliders.png")
    return results


def run_suite(
    folder: Path,
    methods: Mapping[str, SliderMethod],
    perceptual: Perceptual | None = None,
    seed: int = 0,
    threads: int = 0,
    on_result: Callable[[EditResult], None] = lambda result: None,
    suite: Suite | None = None,
) -> list[EditResult]:
    """Compare methods on every edit, and write FOLDER/sliders.json and sliders.png.

    Args:
        folder: folder for scenes, pictures, runs and results; created if missing
        methods: the methods by name; the first is the one that others are compared with
        perceptual: LPIPS or its substitute; None: LPIPS if its weights are installed
        seed: seed of the trainings
        threads: CPU threads; 0: all cores
        on_result: called after each edit
        suite: version of the suite; None: the current one

    Raises:
        ProgdfError: a method fails, or the folder cannot be written to.
    """
    prepare_process(threads)
    make_folder(folder)
    perceptual = perceptual or perceptual_loss()[0]
    suite = suite or SUITES["sliders"]
    scenes: dict[str, DemoScene] = {}
    results = []
    for edit in suite.edits:
        if edit.scene not in scenes:
            scenes[edit.scene] = load_suite_scene(folder, edit.scene, suite.sizes.get(edit.scene, 0))
        task, truth = make_task(edit, scenes[edit.scene], folder, suite.effort, threads, seed)
        results.append(_compare(edit, task, truth, methods, perceptual))
        on_result(results[-1])
    write_json(folder / "sliders.json", suite_json(results, perceptual.name, suite, seed, threads))
    write_image(folder / "sliders.png", suite_picture(results))
    return results


def _compare(
    edit: KnownEdit,
    task: EditTask,
    truth: KnownTruth,
    methods: Mapping[str, SliderMethod],
    perceptual: Perceptual,
) -> EditResult:
    """Fit every method to one edit, and measure it in the held-out views."""
    make_folder(task.folder)
    sources: dict[str, Pictures] = {}
    seconds: dict[str, float] = {}
    for name, method in methods.items():
        started = time.process_time()
        slider = _fit(name, method, task)
        seconds[name] = time.process_time() - started
        sources[name] = _render_slider(name, slider, truth)
    sources[FADE] = _fade(truth)
    seconds[FADE] = 0.0
    errors = {name: {m: np.zeros((len(truth.views), len(STRENGTHS))) for m in MEASURES} for name in sources}
    for column, s in enumerate(STRENGTHS):
        expected = truth.boxes(s)
        for name, pictures in sources.items():
            _measure(truth, pictures(s), expected, perceptual, errors[name], column)
        perceptual.forget()
    pixels = [int(mask.sum()) for mask in truth.evaluator.pixels]
    largest = pixels.index(max(pixels))
    strips = {
        name: [pictures(s)[largest] for s in SHOWN_STRENGTHS]
        for name, pictures in {"truth": truth.boxes, **sources}.items()
    }
    view_names = tuple(truth.evaluator.names)
    return EditResult(edit, len(task.scene), len(task.region), view_names, errors, seconds, strips)


def _measure(
    truth: KnownTruth,
    pictures: Sequence[Tensor],
    expected: Sequence[Tensor],
    perceptual: Perceptual,
    errors: Mapping[str, np.ndarray],
    column: int,
) -> None:
    """Write the errors of each view to one column."""
    for view in range(len(truth.views)):
        alone = truth.evaluator.only([view])
        pair = (pictures[view : view + 1], expected[view : view + 1])
        errors["psnr"][view, column] = alone.psnr(*pair)
        errors["ssim"][view, column] = alone.ssim(*pair)
        errors["lpips"][view, column] = alone.perceptual(*pair, perceptual, ("suite", view))


def _fit(name: str, method: SliderMethod, task: EditTask) -> Slider:
    try:
        slider = method(task)
    except ProgdfError:
        raise
    except Exception as error:
        raise _failure(name, task.name, error) from error
    if not callable(slider):
        raise ProgdfError(
            f"the method {name} returned a {type(slider).__name__}; return a function of the strength"
        )
    return slider


def _render_slider(name: str, slider: Slider, truth: KnownTruth) -> Pictures:
    """Return a function from strength to the boxes of a slider's held-out views."""

    def pictures(s: float) -> list[Tensor]:
        try:
            scene = slider(s)
        except Exception as error:
            raise _failure(name, f"strength {s:g}", error) from error
        if not isinstance(scene, Gaussians):
            raise ProgdfError(
                f"the slider of {name} returned a {type(scene).__name__}; return progdf.gaussians.Gaussians"
            )
        with torch.no_grad():
            return truth.render(scene)

    return pictures


def _failure(name: str, where: str, error: Exception) -> ProgdfError:
    return ProgdfError(
        f"the method {name} failed at {where} ({type(error).__name__}: {error}); correct the method"
    )


def _fade(truth: KnownTruth) -> Pictures:
    """Return the cross-fade between the true pictures of both ends."""
    first = truth.boxes(0.0)
    last = truth.boxes(1.0)
    return lambda s: [torch.lerp(a, b, s) for a, b in zip(first, last, strict=True)]


def _print_result(result: EditResult) -> None:
    figures = ", ".join(
        f"{name} {errors['psnr'][:, 1:-1].mean():.1f}" for name, errors in result.errors.items()
    )
    print_line(f"{result.edit.name}: PSNR at 0.1 to 0.9, dB: {figures}")
