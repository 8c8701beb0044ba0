"""The benchmark `trained-motion`: edits of parts that move smoothly, with the truth at every strength.

Points of a scene are pulled (`progdf.pull`), and pictures of the end are the edited views of a full run with
the editor folder. Held-out views compare the slider at 0.5 and 1 with the pull's own course.

    python -m benchmarks trained-motion --scenes playbot_31k.ply plant.ply

The playbot needs playbot_31k_labels.npy beside it. Its pulls are skipped without it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor

from progdf.demo_scenes import bear
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import Gaussians, pack
from progdf.gdf.file import load_gdf
from progdf.io.images import write_image
from progdf.pull.course import Handle, PullCourse, pull
from progdf.rasterize import render
from progdf.region import Region, from_mask
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.options import EditorOptions, OptimizeOptions, RegionOptions, TrainingViewOptions, TrainOptions
from trainer.resolve import resolve
from trainer.run.run import train
from trainer.store.run_folder import quantize_image
from trainer.views.setup import TrainingSetup, make_training_setup
from trainer.views.view import View

from ..table import Table

STEPS = 240
VIEWS = 15
SIZE = 160  # pixels
_BEAR_GAUSSIANS = 12_000
_ROBOT_LABELS = 1, 2, 3  # the robot and its hands
_HALF_STRENGTHS = 0.4, 0.425, 0.45, 0.475, 0.5, 0.525, 0.55, 0.575, 0.6
"""Slider values compared with the half pull, as an even slider has its own timing."""


@dataclass(frozen=True)
class PullCase:
    """One pull of a scene."""

    name: str
    scene: Gaussians
    labels: Tensor  # 1 for the Gaussians of the trained region, else 0. [N] uint8
    course: PullCourse  # the truth

    @property
    def region(self) -> Region:
        """The trained region."""
        return from_mask("region", self.labels == 1)

    def edited(self, strength: float) -> Gaussians:
        """Return the scene pulled to a strength."""
        members = self.course.region.members
        rows = pack(self.scene[members], with_shN=self.scene.sh_degree > 0)
        return self.scene.replace_rows(members, rows + self.course.offsets_at(strength))


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure the pulls of the bear and of known scenes: playbot_31k.ply and plant.ply.

    Raises:
        ProgdfError: a scene has no pulls, or no labels file.
    """
    cases = bear_pulls()
    for path in scenes:
        cases += _scene_pulls(path)
    note = (
        "PSNR over the evaluated pixels of held-out views, dB. half: the slider at 0.5 against the pull's "
        "own half way; nearest: the best of the slider from 0.4 to 0.6, as an even slider has its own "
        f"timing. The trainer sees {VIEWS} views of {SIZE} pixels of the full pull, and takes {STEPS} "
        "steps. moved by: the motion that the run chose; seconds: processor time of the run."
    )
    columns = ("pull", "members", "unedited", "end", "half", "nearest", "moved by", "seconds")
    return [
        Table(
            "trained-motion", "Parts that move smoothly", columns, tuple(_row(case) for case in cases), note
        )
    ]


def bear_pulls() -> list[PullCase]:
    """Return the bear's smile, raised brow, fat belly and lifted arm."""
    demo = bear(_BEAR_GAUSSIANS)
    scene = demo.gaussians
    head = _member_mask(len(scene), demo.members("head"))
    body = _member_mask(len(scene), demo.members("body"))
    arms = _member_mask(len(scene), demo.members("arms"))
    smile = [
        ((0.11, 1.305, 0.56), (0.06, 0.07, 0.0), 0.15),
        ((-0.11, 1.305, 0.56), (-0.06, 0.07, 0.0), 0.15),
    ]
    brow = [((0.17, 1.62, 0.48), (0.02, 0.09, 0.0), 0.18)]
    belly = [((0.0, 0.55, 0.40), (0.0, -0.03, 0.22), 0.55)]
    arm = [((0.52, 0.55, 0.28), (0.12, 0.18, 0.05), 0.5)]
    return [
        _pull_case("bear: smile", scene, head, smile),
        _pull_case("bear: raised brow", scene, head, brow),
        _pull_case("bear: fat belly", scene, body, belly),
        _pull_case("bear: lifted arm", scene, arms, arm),
    ]


def _scene_pulls(path: Path) -> list[PullCase]:
    scene = load_ply(path)
    if path.stem == "plant":
        top = scene.means[:, 1] < -0.2
        leaf = [((0.0, -0.45, 0.0), (0.1, 0.03, 0.05), None)]
        return [_pull_case("plant: bent top", scene, top, leaf, base=0.15)]
    if not path.stem.startswith("playbot"):
        raise ProgdfError(f"{path} has no pulls; give playbot_31k.ply or plant.ply")
    labels = path.with_name(f"{path.stem}_labels.npy")
    if not labels.is_file():
        raise ProgdfError(f"{labels} does not exist; put the labels of the robot beside {path.name}")
    parts = np.load(labels)
    robot = torch.from_numpy(np.isin(parts, _ROBOT_LABELS))
    tail = [((0.0, -0.21, 0.0), (0.22, -0.1, 0.05), 0.55)]
    hand = [((0.5, -0.6, -0.1), (0.12, -0.1, 0.0), 0.22)]
    chest = [((0.0, -0.7, -0.27), (0.0, 0.0, -0.12), 0.3)]
    return [
        _pull_case(f"{path.stem}: bent tail", scene, robot, tail),
        _pull_case(f"{path.stem}: opened hand", scene, robot, hand),
        _pull_case(f"{path.stem}: chest out", scene, robot, chest),
    ]


def _member_mask(count: int, members: Tensor) -> Tensor:
    return torch.zeros(count, dtype=torch.bool).index_fill(0, members, True)


def _pull_case(
    name: str,
    scene: Gaussians,
    member: Tensor,
    pulls: Sequence[tuple[tuple[float, float, float], tuple[float, float, float], float | None]],
    base: float = 0.0,
) -> PullCase:
    """Return a pull of a region.

    Args:
        name: name of scene and pull
        scene: the original
        member: Gaussians of the region. [N] bool
        pulls: points near the surface, how far they go, and the radius of the falloff
        base: share of the region's height, counted from +y, that is held
    """
    region = from_mask("region", member)
    means = scene.means[region.members]
    handles = []
    for point, distance, falloff in pulls:
        nearest = means[(means - torch.tensor(point)).norm(dim=1).argmin()]
        x, y, z = nearest.tolist()
        handles.append(Handle(region, (x, y, z), distance, falloff))
    hold = None
    if base:
        height = means[:, 1].quantile(1.0 - base)
        hold = from_mask("base", member & (scene.means[:, 1] >= height))
    return PullCase(name, scene, member.to(torch.uint8), pull(scene, handles, hold))


def _row(case: PullCase) -> tuple[str, ...]:
    run = measure_run(case)
    numbers = (f"{value:.1f}" for value in (run.unedited, run.end, run.half, run.nearest))
    return case.name, str(len(case.region)), *numbers, run.moved_by, f"{run.seconds:.0f}"


@dataclass(frozen=True)
class PulledRun:
    """Figures of a run; PSNR in dB."""

    unedited: float  # of the original against the full pull
    end: float  # at strength 1
    half: float  # at strength 0.5
    nearest: float  # at the strength from 0.4 to 0.6 that is nearest to the half pull
    moved_by: str  # kind of motion that the run chose
    seconds: float  # processor time


def measure_run(case: PullCase) -> PulledRun:
    """Train a pull from its pictures."""
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        save_ply(folder / "scene.ply", case.scene)
        np.save(folder / "labels.npy", case.labels.numpy())
        options = TrainOptions(
            folder / "scene.ply",
            folder / "run",
            RegionOptions(f"labels:{folder / 'labels.npy'}:1"),
            EditorOptions(f"folder:{folder / 'edited'}"),
            views=TrainingViewOptions(views=VIEWS, image_size=SIZE),
            optimize=OptimizeOptions(STEPS),
        )
        setup = make_training_setup(resolve(options).views, case.scene, case.region)
        for view in setup.views:
            write_image(folder / "edited" / f"{view.camera.name}.png", _picture(case, view, setup, 1.0))
        begun = time.process_time()
        result = train(options, quiet=True)
        seconds = time.process_time() - begun
        field = load_gdf(result.gdf).field
        log = result.folder.log.read_text(encoding="utf-8")
    channels = field.channels

    def judge(strength: float) -> Evaluator:
        truth = {strength: [_picture(case, view, setup, strength) for view in setup.held_out]}
        return make_evaluator(case.scene, setup.region, setup.held_out, truth, setup.background, channels)

    def psnr(evaluator: Evaluator, offsets: Tensor) -> float:
        (expected,) = evaluator.edited.values()
        return evaluator.psnr(evaluator.pictures(offsets), expected)

    full = judge(1.0)
    half = judge(0.5)
    halves = {strength: psnr(half, field.offsets(strength)) for strength in _HALF_STRENGTHS}
    return PulledRun(
        psnr(full, torch.zeros_like(full.original)),
        psnr(full, field.offsets(1.0)),
        halves[0.5],
        max(halves.values()),
        _moved_by(log),
        seconds,
    )


def _picture(case: PullCase, view: View, setup: TrainingSetup, strength: float) -> Tensor:
    with torch.no_grad():
        image = render(case.edited(strength), view.camera, setup.background).image
    return quantize_image(image.clamp(0.0, 1.0))


def _moved_by(log: str) -> str:
    """Return the kind of motion that a log reports."""
    kinds = {"moved by": "nodes", "bent by": "control points", "part 0,": "parts"}
    return next((kind for text, kind in kinds.items() if text in log), "members")
