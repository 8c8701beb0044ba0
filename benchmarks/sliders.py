"""The command `python -m benchmarks sliders FOLDER`: edits of the demo scenes with known pictures.

A color editor defines every view at any strength, and an analytic edit every Gaussian. The trainer gets
pictures of its training views at 8 strengths. The comparison uses held-out views at 11 strengths.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import tyro
from torch import Tensor

from progdf.demo_scenes import DemoScene, bear, room
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply
from progdf.gaussians import Gaussians
from progdf.io.atomic import make_folder
from progdf.io.images import contact_sheet, to_picture, write_image
from progdf.metrics.slider import Pictures
from progdf.scene.regions import parse_region
from progdf.terminal import print_line
from trainer.batch.jobs import BatchJob
from trainer.batch.run import run
from trainer.editors import make_editor
from trainer.evaluate.measures import markdown_table
from trainer.evaluate.opened import FADE, KEYFRAMES, SLIDER, OpenedRun, open_run
from trainer.optimize.losses import Perceptual, perceptual_loss
from trainer.options import EditorOptions, OptimizeOptions, RegionOptions, TrainingViewOptions, TrainOptions
from trainer.report.measures import ErrorCurve, error_curves
from trainer.report.plots import Plot
from trainer.report.report import stack_plots, thumbnail
from trainer.resolve import prepare_process, resolve
from trainer.run.demo import Effort, write_scene
from trainer.run.resume import find_run
from trainer.store.run_folder import write_json
from trainer.views.setup import make_training_setup, render_thumbnails
from trainer.views.view import crop, render_view

from .analytic_edits import AnalyticEdit, bear_edits
from .table import mean_worst

STRENGTHS = tuple(i / 10 for i in range(11))
"""Strengths at which sliders are compared with the truth; 0 is exact for all."""

ASKED = 8
"""Number of evenly spaced strengths at which the trainer gets pictures."""

SIZES = {"bear": 12_000, "room": 20_000}
"""Number of Gaussians by scene."""

_COMPARED = (SLIDER, KEYFRAMES, FADE)
_THUMBNAIL_WIDTH = 170  # pixels
_PLOTS_PER_ROW = 5

EFFORT = Effort(views=20, image_size=192, steps=480)


@dataclass(frozen=True)
class SliderOptions:
    """Train edits of the demo scenes with known pictures, and compare the sliders with them at 11 strengths.

    Finished runs are not trained again.
    """

    folder: tyro.conf.Positional[Path]
    """Folder for scenes, pictures, runs and the table; created if missing."""
    threads: int = 1
    """CPU threads per run; as many runs as the cores allow are trained at once."""


def run_sliders(options: SliderOptions) -> list[CaseResult]:
    """Train and compare the edits, write FOLDER/sliders.json and sliders.png, and print a table.

    Raises:
        ProgdfError: the folder cannot be written to, or holds other runs.
    """
    prepare_process(options.threads)
    make_folder(options.folder)
    perceptual, warning = perceptual_loss()
    if warning:
        print_line(warning.replace("training with", "measuring with"))
    results = run_suite(options.folder, perceptual, options.threads, print_line)
    write_json(options.folder / "sliders.json", suite_json(results, perceptual.name))
    write_image(options.folder / "sliders.png", suite_picture(results))
    for line in suite_table(results).splitlines():
        print_line(line)
    print_line(f"wrote {options.folder / 'sliders.json'} and sliders.png")
    return results


@dataclass(frozen=True)
class KnownEdit:
    """An edit of a demo scene with known pictures."""

    name: str  # name of the edit; for an analytic one, its name in `bear_edits`
    scene: Literal["bear", "room"]  # the demo scene
    parts: tuple[str, ...]  # labels of the region
    editor: str = ""  # `KIND:WHAT` of a color editor; "" for an analytic edit

    @property
    def folder(self) -> str:
        """Name of its run folder."""
        return self.name.replace(" ", "-")


_COAT = ("body", "head", "ears", "arms", "legs")
CASES = (
    KnownEdit("blue scarf", "bear", ("scarf",), "recolor:#2356c7"),
    KnownEdit("gold coat", "bear", _COAT, "recolor:#d89a12"),
    KnownEdit("tinted coat", "bear", _COAT, "tint:#4f6fd8"),
    KnownEdit("striped body", "bear", ("body", "arms"), "stripes:#2b62c9"),
    KnownEdit("night", "bear", (*_COAT, "scarf", "plinth", "grass"), "night"),
    KnownEdit("blue rug", "room", ("rug",), "recolor:#3a55b4"),
    KnownEdit("big ears", "bear", ("ears",)),
    KnownEdit("tilted ears", "bear", ("ears",)),
    KnownEdit("long ears", "bear", ("ears",)),
    KnownEdit("bent ears", "bear", ("ears",)),
)


@dataclass(frozen=True)
class CaseResult:
    """Figures of one edit."""

    case: KnownEdit  # the edit
    members: int  # number of Gaussians in its region
    bytes_per_member: float  # of the shipped field
    seconds: float | None  # duration of the run, from its report
    curves: Mapping[str, ErrorCurve]  # against the truth at `STRENGTHS`, by contender
    # the best held-out view at strengths 0.5 and 1, of the truth and each contender. [h,w,3] each
    strips: Mapping[str, tuple[Tensor, Tensor]]


def run_suite(
    folder: Path,
    perceptual: Perceptual,
    threads: int = 1,
    told: Callable[[str], None] = lambda line: None,
    cases: Sequence[KnownEdit] = CASES,
    sizes: Mapping[str, int] = SIZES,
    effort: Effort = EFFORT,
) -> list[CaseResult]:
    """Train and evaluate every edit; finished runs are not trained again.

    Args:
        folder: folder for scenes, pictures and runs; created if missing
        perceptual: LPIPS or its substitute
        threads: CPU threads of a run
        told: called with a line for each trained edit
        cases: the edits
        sizes: number of Gaussians by scene
        effort: views, image size and steps of the training

    Raises:
        ProgdfError: the folder cannot be written to, or holds other runs.
    """
    makers = {"bear": bear, "room": room}
    scenes: dict[str, DemoScene] = {}
    jobs = []
    for case in cases:
        if case.scene not in scenes:
            scene = makers[case.scene](sizes[case.scene])
            write_scene(folder / case.scene, scene)
            # as the trainer reads it: the file rounds by up to half a step
            scenes[case.scene] = replace(scene, gaussians=load_ply(folder / case.scene / "scene.ply"))
        options = replace(_train_options(folder, case, scenes[case.scene], effort), threads=threads)
        _prepare_truth(folder, case, scenes[case.scene], options)
        jobs.append(BatchJob(case.name, options))
    for row in run(jobs):
        told(row.line)
        if row.status != "done":
            raise ProgdfError(f"{row.job}: {row.reason}")
    return [_judge_case(folder, case, scenes[case.scene], perceptual) for case in cases]


def _prepare_truth(folder: Path, case: KnownEdit, scene: DemoScene, options: TrainOptions) -> None:
    """Write the pictures of an analytic edit, unless its run exists already."""
    truth_folder = folder / "truth" / case.folder
    if not case.editor:
        make_folder(truth_folder)
        if find_run(options) == "nothing":
            _write_truth(truth_folder, resolve(options), scene.gaussians, _analytic(case, scene))


def _judge_case(folder: Path, case: KnownEdit, scene: DemoScene, perceptual: Perceptual) -> CaseResult:
    opened = open_run(folder / case.folder)
    truth = _truth(case, opened, scene)
    contenders = opened.contenders()
    curves = error_curves(opened.evaluator, contenders, STRENGTHS, truth, perceptual)
    best = max(range(len(opened.evaluator.pixels)), key=lambda k: int(opened.evaluator.pixels[k].sum()))
    sources = {"truth": truth, **contenders}
    strips = {name: (pictures(0.5)[best], pictures(1.0)[best]) for name, pictures in sources.items()}
    seconds = opened.report.get("time", {}).get("total")
    field = opened.gdf.field
    return CaseResult(case, len(opened.gdf.region), field.bytes_per_member, seconds, curves, strips)


def _train_options(folder: Path, case: KnownEdit, scene: DemoScene, effort: Effort) -> TrainOptions:
    scene_folder = folder / case.scene
    ids = ",".join(str(scene.label_names.index(part)) for part in case.parts)
    cameras = scene_folder / "cameras.json" if case.scene == "room" else None  # its cameras are inside
    return TrainOptions(
        scene=scene_folder / "scene.ply",
        out=folder / case.folder,
        region=RegionOptions(f"labels:{scene_folder / 'labels.npy'}:{ids}"),
        editor=EditorOptions(case.editor or f"folder:{folder / 'truth' / case.folder}"),
        views=TrainingViewOptions(cameras, views=effort.views, image_size=effort.image_size),
        # stages 0: one per strength in the folder; the slider value is the editor's strength
        optimize=OptimizeOptions(effort.steps, stages=ASKED if case.editor else 0, slider="stages"),
    )


def _analytic(case: KnownEdit, scene: DemoScene) -> AnalyticEdit:
    return bear_edits(scene)[case.name][0]


def _write_truth(folder: Path, options: TrainOptions, scene: Gaussians, edit: AnalyticEdit) -> None:
    """Draw the edit in the views that the run will have, as DIR/STRENGTH/NAME.png."""
    region = parse_region(options.region.region, scene, options.name)
    setup = make_training_setup(options.views, scene, region)
    for strength in ((i + 1) / ASKED for i in range(ASKED)):
        edited = edit.apply(scene, region.members, strength)
        for view in setup.views:
            picture = render_view(edited, view.camera, setup.background)
            write_image(folder / f"{strength:g}" / f"{view.camera.name}.png", picture)


def _truth(case: KnownEdit, opened: OpenedRun, scene: DemoScene) -> Pictures:
    """Return a function from strength to the true boxes of the held-out views."""
    setup = opened.setup
    boxes = [crop_scene.box for crop_scene in opened.evaluator.crops]
    if case.editor:
        options = EditorOptions(case.editor)
        glances = partial(render_thumbnails, opened.run.record.plan.views, setup.scene, setup.region)
        editor = make_editor(options, setup.scene, setup.region, setup.views, glances)

        def pictures(s: float) -> list[Tensor]:
            return [editor.edit(view, s) for view in setup.judging]

    else:
        edit = _analytic(case, scene)
        members = setup.region.members

        def pictures(s: float) -> list[Tensor]:
            edited = edit.apply(setup.scene, members, s)
            return [render_view(edited, view.camera, setup.background).clamp(0, 1) for view in setup.judging]

    return lambda s: [crop(picture, box) for picture, box in zip(pictures(s), boxes, strict=True)]


def suite_rows(results: Sequence[CaseResult]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return headings and a row per edit: mean and worst PSNR and mean LPIPS over strengths 0.1 to 1."""
    head = (
        "edit",
        "members",
        *(f"{name}, PSNR mean / worst, dB" for name in _COMPARED),
        *(f"{name}, LPIPS" for name in _COMPARED),
        "PSNR at 1, dB",
        "bytes a member",
    )
    rows = [
        (
            result.case.name,
            str(result.members),
            *(mean_worst(result.curves[name].psnr[1:]) for name in _COMPARED),
            *(f"{fmean(result.curves[name].lpips[1:]):.4f}" for name in _COMPARED),
            f"{result.curves[SLIDER].psnr[-1]:.1f}",
            f"{result.bytes_per_member:.0f}",
        )
        for result in results
    ]
    return head, rows


def suite_table(results: Sequence[CaseResult]) -> str:
    """Format `suite_rows` as a Markdown table."""
    return markdown_table(*suite_rows(results))


def suite_json(results: Sequence[CaseResult], perceptual: str) -> dict[str, Any]:
    """Return the content of sliders.json."""
    edits = {
        result.case.name: {
            "scene": result.case.scene,
            "editor": result.case.editor or "analytic",
            "members": result.members,
            "bytes_per_member": round(result.bytes_per_member, 1),
            "seconds": result.seconds,
            "curves": {
                name: {"psnr": curve.psnr, "ssim": curve.ssim, "lpips": curve.lpips}
                for name, curve in result.curves.items()
            },
        }
        for result in results
    }
    return {"perceptual": perceptual, "strengths": STRENGTHS, "edits": edits}


def suite_picture(results: Sequence[CaseResult]) -> Tensor:
    """Draw each edit at strengths 0.5 and 1, and PSNR over the slider below. -> [H,W,3]"""
    names = ("truth", *_COMPARED)
    rows = [
        [thumbnail(_square(result.strips[name][end]), _THUMBNAIL_WIDTH) for end in (0, 1) for name in names]
        for result in results
    ]
    heads = [f"{name}, {s}" for s in (".5", "1") for name in names]
    sheet = contact_sheet(rows, [result.case.name for result in results], heads, "Sliders against the truth")
    plots = [
        Plot(
            f"{result.case.name}: PSNR, dB",
            {name: (STRENGTHS[1:], result.curves[name].psnr[1:]) for name in _COMPARED},
            "slider",
            span=(0.0, 1.0),
        )
        for result in results
    ]
    lines = [plots[i : i + _PLOTS_PER_ROW] for i in range(0, len(plots), _PLOTS_PER_ROW)]
    return stack_plots(to_picture(sheet), lines)


def _square(image: Tensor) -> Tensor:
    """Center an image on a white square, so that all thumbnails have one size. [h,w,3] -> [n,n,3]"""
    height, width = image.shape[:2]
    side = max(height, width)
    page = image.new_ones(side, side, 3)
    top = (side - height) // 2
    left = (side - width) // 2
    page[top : top + height, left : left + width] = image
    return page
