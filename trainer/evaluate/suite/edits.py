"""Edits of the suite `sliders`: scenes whose pictures are known at every strength.

A color editor defines every view at any strength, and an analytic edit every Gaussian. A method receives
pictures of the training views at 8 strengths. It is compared in other views at 11 strengths.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from progdf.demo_scenes import DemoScene
from progdf.gaussians import Gaussians
from progdf.metrics.image import round_to_8_bits
from progdf.metrics.slider import Pictures
from progdf.region import Region
from progdf.system.equality import equal_fields
from trainer.editors import make_editor
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.options import EditorOptions, TrainingViewOptions
from trainer.run.demo import Effort
from trainer.views.setup import TrainingSetup, make_training_setup, render_thumbnails
from trainer.views.view import View, crop, render_view

from .analytic_edits import FORMULAS

GIVEN = tuple((i + 1) / 8 for i in range(8))
"""Strengths at which a method receives pictures; at 0 they are the views of the original."""

STRENGTHS = tuple(i / 10 for i in range(11))
"""Strengths at which a method is compared with the truth."""


@dataclass(frozen=True)
class KnownEdit:
    """An edit with known pictures."""

    name: str  # name of the edit; for an analytic one, its name in `FORMULAS`
    scene: str  # a made scene or a capture, see `scenes`
    parts: tuple[str, ...]  # labels of the region
    editor: str = ""  # `KIND:WHAT` of a color editor; "" for an analytic edit

    @property
    def folder(self) -> str:
        """Name of its folder."""
        return self.name.replace(" ", "-")


@dataclass(frozen=True)
class Suite:
    """One version of the suite, which never changes, so that its results stay comparable.

    Another edit, scene, view or measure is another version.
    """

    version: int
    edits: tuple[KnownEdit, ...]
    sizes: Mapping[str, int]  # number of Gaussians of each made scene
    # number of views, a sixth of which are held out, their longer side in pixels, and steps of a training
    effort: Effort
    methods: tuple[str, ...]  # methods by default


_COAT = ("body", "head", "ears", "arms", "legs")
SUITES: Mapping[str, Suite] = {
    # small regions, as the paper's network takes processor time with the number of members
    "sliders": Suite(
        version=2,
        edits=(
            KnownEdit("blue scarf", "bear", ("scarf",), "recolor:#2356c7"),
            KnownEdit("striped body", "bear", ("body", "arms"), "stripes:#2b62c9"),
            KnownEdit("big ears", "bear", ("ears",)),
            KnownEdit("bent ears", "bear", ("ears",)),
            KnownEdit("green hand", "robot", ("right hand",), "tint:#30b060"),
            KnownEdit("dark head", "robot", ("head",), "darken:0.75"),
            KnownEdit("raised hand", "robot", ("left hand",)),
            KnownEdit("fading hand", "robot", ("left hand",)),
            KnownEdit("red letters", "box", ("letters",), "recolor:#b02020"),
            KnownEdit("moved letters", "box", ("letters",)),
        ),
        sizes={"bear": 5_000},
        effort=Effort(views=24, image_size=128, steps=160),
        methods=("field", "keyframes", "matrix", "paper"),
    ),
    "sliders-1": Suite(
        version=1,
        edits=(
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
        ),
        sizes={"bear": 12_000, "room": 20_000},
        effort=Effort(views=24, image_size=192, steps=480),
        methods=("field", "keyframes", "matrix"),
    ),
}
"""Versions of the suite by their name on the command line. The first is the current one."""


@dataclass(frozen=True)
class EditTask:
    """One edit as a method receives it."""

    __eq__ = equal_fields

    name: str  # name of the edit
    scene: Gaussians  # the original
    region: Region  # the Gaussians that the edit changes
    views: Sequence[View]  # training views of the original: cameras, images and the region's weights
    # strength → edited pictures of the views, 8 bits. [H,W,3] each
    pictures: Mapping[float, Sequence[Tensor]]
    background: Tensor  # color behind the scene, rgb, 0 to 1. [3]
    scene_file: Path  # .ply of the same scene
    folder: Path  # folder for files of the method, maybe from an earlier call with the same task
    effort: Effort  # views, image size and steps of a training
    threads: int  # CPU threads; 0: all cores
    seed: int  # seed for random numbers


@dataclass(frozen=True)
class KnownTruth:
    """Held-out views of one edit, with their true pictures."""

    __eq__ = equal_fields

    evaluator: Evaluator  # the views' boxes and the evaluated pixels
    views: Sequence[View]  # the same views
    background: Tensor  # rgb. [3]
    boxes: Pictures  # strength → true pictures of the boxes. [h,w,3] each

    def render(self, scene: Gaussians) -> list[Tensor]:
        """Render the boxes of all views. -> [h,w,3] each"""
        pictures = [render_view(scene, view.camera, self.background) for view in self.views]
        crops = zip(pictures, self.evaluator.crops, strict=True)
        return [crop(picture, crop_scene.box).clamp(0, 1) for picture, crop_scene in crops]


def make_task(
    edit: KnownEdit, labeled: DemoScene, folder: Path, effort: Effort, threads: int, seed: int
) -> tuple[EditTask, KnownTruth]:
    """Return an edit as a method receives it, and its truth.

    Args:
        edit: the edit
        labeled: its scene
        folder: folder of the suite, which holds the scene
        effort: views, image size and steps of a training
        threads: CPU threads; 0: all cores
        seed: seed for random numbers
    """
    scene = labeled.gaussians
    members = labeled.members(*edit.parts)
    score = torch.zeros(len(scene)).index_fill(0, members, 1.0)
    region = Region(edit.folder, members, score)
    cameras = folder / edit.scene / "cameras.json" if edit.scene == "room" else None  # its cameras are inside
    is_color = bool(edit.editor)  # other edits move parts, which need room in the views
    options = TrainingViewOptions(
        cameras, views=effort.views, image_size=effort.image_size, dense=is_color, fills=is_color
    )
    setup = make_training_setup(options, scene, region)
    true_pictures = _true_pictures(edit, labeled, setup, options)
    given = {s: [round_to_8_bits(picture) for picture in true_pictures(s, setup.train)] for s in GIVEN}
    task = EditTask(
        name=edit.name,
        scene=scene,
        region=region,
        views=setup.train,
        pictures=given,
        background=setup.background,
        scene_file=folder / edit.scene / "scene.ply",
        folder=folder / edit.folder,
        effort=effort,
        threads=threads,
        seed=seed,
    )
    return task, _known_truth(setup, true_pictures)


_TruePictures = Callable[[float, Sequence[View]], list[Tensor]]
"""Function from a strength and views to their true pictures. [H,W,3] each"""


def _true_pictures(
    edit: KnownEdit, labeled: DemoScene, setup: TrainingSetup, options: TrainingViewOptions
) -> _TruePictures:
    scene = labeled.gaussians
    if edit.editor:
        glances = partial(render_thumbnails, options, scene, setup.region)
        editor = make_editor(EditorOptions(edit.editor), scene, setup.region, setup.views, glances)
        return lambda s, views: [editor.edit(view, s) for view in views]
    formula = FORMULAS[edit.scene](labeled)[edit.name][0]

    def pictures(s: float, views: Sequence[View]) -> list[Tensor]:
        edited = formula.apply(scene, setup.region.members, s)
        return [render_view(edited, view.camera, setup.background).clamp(0, 1) for view in views]

    return pictures


def _known_truth(setup: TrainingSetup, true_pictures: _TruePictures) -> KnownTruth:
    views = setup.held_out
    edited = {s: true_pictures(s, views) for s in GIVEN}
    evaluator = make_evaluator(setup.scene, setup.region, views, edited, setup.background, channels=14)
    crop_boxes = [crop_scene.box for crop_scene in evaluator.crops]

    def boxes(s: float) -> list[Tensor]:
        return [crop(picture, box) for picture, box in zip(true_pictures(s, views), crop_boxes, strict=True)]

    return KnownTruth(evaluator, views, setup.background, boxes)
