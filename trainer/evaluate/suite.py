"""The suite `sliders`: edits of the demo scenes whose picture is known at every strength.

An editor of colors says what a view shows at any strength, an analytic edit what every Gaussian is. The
trainer sees pictures of its training views at 8 strengths; compared are held-out views at 11.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from torch import Tensor

from progdf.demo_scenes import AnalyticEdit, DemoScene, bear, bear_edits, room
from progdf.formats.ply import load_ply
from progdf.gaussians import Gaussians
from progdf.io.atomic import make_folder
from progdf.io.images import write_image
from progdf.metrics.slider import Pictures
from progdf.scene.regions import parse_region
from trainer.editors import make_editor
from trainer.optimize.losses import Perceptual
from trainer.options import TrainOptions
from trainer.pipeline.demo import Effort, write_scene
from trainer.pipeline.resume import find_run
from trainer.pipeline.run import train
from trainer.plan import Plan, make_plan
from trainer.report.curves import ErrorCurve, picture_courses
from trainer.setup.training_setup import make_training_setup
from trainer.views.view import crop, render_view

from .opened import OpenedRun, open_run

STRENGTHS = tuple(i / 10 for i in range(11))
"""At which sliders are compared with the truth; 0 is exact for all."""

ASKED = 8
"""Strengths at which the trainer is given pictures, evenly."""

SIZES = {"bear": 12_000, "room": 20_000}
"""Gaussians of the scenes."""

EFFORT = Effort(views=20, image_size=192, steps=480)


@dataclass(frozen=True)
class SliderCase:
    """One edit.

    Args:
        name: of the edit; of an analytic one as `bear_edits` names it
        scene: the demo scene
        parts: what may change
        editor: `KIND:WHAT` of an editor of colors; "" for an analytic edit
    """

    name: str
    scene: Literal["bear", "room"]
    parts: tuple[str, ...]
    editor: str = ""

    @property
    def folder(self) -> str:
        """Its run's name."""
        return self.name.replace(" ", "-")


_COAT = ("body", "head", "ears", "arms", "legs")
CASES = (
    SliderCase("blue scarf", "bear", ("scarf",), "recolor:#2356c7"),
    SliderCase("gold coat", "bear", _COAT, "recolor:#d89a12"),
    SliderCase("tinted coat", "bear", _COAT, "tint:#4f6fd8"),
    SliderCase("striped body", "bear", ("body", "arms"), "stripes:#2b62c9"),
    SliderCase("night", "bear", (*_COAT, "scarf", "plinth", "grass"), "night"),
    SliderCase("blue rug", "room", ("rug",), "recolor:#3a55b4"),
    SliderCase("big ears", "bear", ("ears",)),
    SliderCase("tilted ears", "bear", ("ears",)),
    SliderCase("long ears", "bear", ("ears",)),
    SliderCase("bent ears", "bear", ("ears",)),
)


@dataclass(frozen=True)
class CaseResult:
    """One edit's figures.

    Args:
        case: the edit
        members: how many Gaussians it may change
        bytes_per_member: of the shipped field
        seconds: of the run, as its report tells
        curves: against the truth at `STRENGTHS`, by what is shown
        strips: the best held-out view half way and at the end: the truth, and what is shown. [h,w,3] each
    """

    case: SliderCase
    members: int
    bytes_per_member: float
    seconds: float | None
    curves: Mapping[str, ErrorCurve]
    strips: Mapping[str, tuple[Tensor, Tensor]]


def run_suite(
    folder: Path,
    perceptual: Perceptual,
    threads: int = 0,
    told: Callable[[str], None] = lambda line: None,
    cases: Sequence[SliderCase] = CASES,
    sizes: Mapping[str, int] = SIZES,
    effort: Effort = EFFORT,
) -> list[CaseResult]:
    """Train and judge every edit; runs that are finished are not trained again.

    Args:
        folder: for scenes, pictures and runs; made if need be
        perceptual: LPIPS, or its stand-in
        threads: CPU threads; 0 takes all cores
        told: called with a line before each edit
        cases, sizes, effort: edits, Gaussians of the scenes, training

    Raises:
        ProgdfError: the folder cannot be written to, or holds other runs.
    """
    makers = {"bear": bear, "room": room}
    scenes: dict[str, DemoScene] = {}
    results = []
    for i, case in enumerate(cases, 1):
        if case.scene not in scenes:
            scene = makers[case.scene](sizes[case.scene])
            write_scene(folder / case.scene, scene)
            # as it is read again, half a step of its file's rounding away
            scenes[case.scene] = replace(scene, gaussians=load_ply(folder / case.scene / "scene.ply"))
        told(f"{i} of {len(cases)}: {case.name}")
        results.append(_run_case(folder, case, scenes[case.scene], perceptual, threads, effort))
    return results


def _run_case(
    folder: Path, case: SliderCase, scene: DemoScene, perceptual: Perceptual, threads: int, effort: Effort
) -> CaseResult:
    truth_folder, out = folder / "truth" / case.folder, folder / case.folder
    if not case.editor:
        make_folder(truth_folder)
    plan = _plan(folder, case, scene, effort)
    found = find_run(out, plan)
    if found == "nothing" and not case.editor:
        _write_truth(truth_folder, plan, scene.gaussians, _analytic(case, scene))
    train(plan, out, threads, resume=found != "nothing", quiet=True)
    opened = open_run(out)
    truth, contenders = _truth(case, opened, scene), opened.contenders()
    curves = picture_courses(opened.evaluator, contenders, STRENGTHS, truth, perceptual)
    best = max(range(len(opened.evaluator.pixels)), key=lambda k: int(opened.evaluator.pixels[k].sum()))
    shown = {"truth": truth, **contenders}
    strips = {name: (pictures(0.5)[best], pictures(1.0)[best]) for name, pictures in shown.items()}
    seconds = opened.report.get("time", {}).get("total")
    field = opened.gdf.field
    return CaseResult(case, len(opened.gdf.region), field.bytes_per_member, seconds, curves, strips)


def _plan(folder: Path, case: SliderCase, scene: DemoScene, effort: Effort) -> Plan:
    at = folder / case.scene
    ids = ",".join(str(scene.label_names.index(part)) for part in case.parts)
    options = TrainOptions(
        scene=at / "scene.ply",
        out=folder / case.folder,
        region=f"labels:{at / 'labels.npy'}:{ids}",
        editor=case.editor or f"folder:{folder / 'truth' / case.folder}",
        cameras=at / "cameras.json" if case.scene == "room" else None,  # one stands inside it
        views=effort.views,
        image_size=effort.image_size,
        steps=effort.steps,
        stages=ASKED if case.editor else 0,  # of a folder: as many as it holds
        slider="stages",  # the slider's value is the editor's strength
    )
    return make_plan(options)


def _analytic(case: SliderCase, scene: DemoScene) -> AnalyticEdit:
    return bear_edits(scene)[case.name][0]


def _write_truth(folder: Path, plan: Plan, scene: Gaussians, edit: AnalyticEdit) -> None:
    """Picture the edit in the views that the run will have, DIR/STRENGTH/NAME.png."""
    region = parse_region(plan.region.region, scene, plan.name)
    setup = make_training_setup(plan.views, scene, region)
    for strength in ((i + 1) / ASKED for i in range(ASKED)):
        edited = edit.apply(scene, region.members, strength)
        for view in setup.views:
            picture = render_view(edited, view.camera, setup.background)
            write_image(folder / f"{strength:g}" / f"{view.camera.name}.png", picture)


def _truth(case: SliderCase, opened: OpenedRun, scene: DemoScene) -> Pictures:
    """The held-out views' boxes as they should be at any strength."""
    setup = opened.setup
    boxes = [shown.box for shown in opened.evaluator.crops]
    if case.editor:
        views = setup.views
        editor = make_editor(case.editor, setup.scene, setup.region, views)

        def pictures(s: float) -> list[Tensor]:
            return [editor.edit(view, s) for view in setup.judging]

    else:
        edit, members = _analytic(case, scene), setup.region.members

        def pictures(s: float) -> list[Tensor]:
            edited = edit.apply(setup.scene, members, s)
            return [render_view(edited, view.camera, setup.background).clamp(0, 1) for view in setup.judging]

    return lambda s: [crop(picture, box) for picture, box in zip(pictures(s), boxes, strict=True)]
