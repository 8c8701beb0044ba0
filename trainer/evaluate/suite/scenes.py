"""Scenes of the suite `sliders`: made scenes, and captures whose files are part of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.demo_scenes import DemoScene, bear, room
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply, save_ply
from progdf.formats.scene_file import load_scene
from progdf.io.atomic import make_folder
from progdf.io.session import sha256
from trainer.run.demo import write_scene
from trainer.views.view import BACKGROUND

Box = tuple[float, float, float, float, float, float]
"""Lowest x, y, z and highest x, y, z, world units."""

FOLDER = Path(__file__).parent / "captures"
"""Folder of the captures, with a file of credits."""


@dataclass(frozen=True)
class Capture:
    """A captured scene and its parts."""

    file: str  # name in `FOLDER`
    sha256: str  # of the file. Another file would be another suite
    label_names: tuple[str, ...]  # names of the labels
    labels: str = ""  # name of the file with a label per Gaussian; "": all have label 0
    # parts cut out of one label by a box; each becomes a label of its own, in order
    boxes: Mapping[str, tuple[str, Box]] = field(default_factory=dict)

    def load(self) -> DemoScene:
        """Return the scene with its labels. It has no cameras.

        Raises:
            ProgdfError: the file is missing or not the suite's.
        """
        path = FOLDER / self.file
        if sha256(path) != self.sha256:
            raise ProgdfError(f"{path} is not the file of the suite; reinstall ProGDF Studio")
        scene = load_scene(path)
        labels = torch.zeros(len(scene), dtype=torch.uint8)
        if self.labels:
            labels = torch.from_numpy(np.load(FOLDER / self.labels))
        for number, (whole, box) in enumerate(self.boxes.values(), len(self.label_names)):
            inside = _within(scene.means, box) & (labels == self.label_names.index(whole))
            labels = torch.where(inside, number, labels).to(torch.uint8)
        names = (*self.label_names, *self.boxes)
        return DemoScene(scene, labels, names, (), torch.tensor([0.0, -1.0, 0.0]), BACKGROUND)


CAPTURES: Mapping[str, Capture] = {
    "robot": Capture(
        "robot.compressed.ply",
        "aab8804460020530b965ce3f83d6f500dd88982b1346d903ee3ef393c328ba0e",
        ("ground", "body", "right hand", "left hand"),
        labels="robot_labels.npy",
        boxes={"head": ("body", (-1.0, -1.1, -1.0, 1.0, -0.95, 1.0))},
    ),
    "box": Capture(
        "box.sog",
        "8c42265c91624ead95f06ca232100eb85202b657a8bc18e7b65a2bb43ea28d86",
        ("scene",),
        boxes={"letters": ("scene", (0.03, -0.03, -0.05, 0.2, 0.085, 0.07))},
    ),
}
"""Captures by name."""

MADE: Mapping[str, Callable[[int], DemoScene]] = {"bear": bear, "room": room}
"""Functions from a number of Gaussians to a made scene, by name."""


def load_suite_scene(folder: Path, name: str, size: int) -> DemoScene:
    """Write a scene to FOLDER/NAME/scene.ply, and return it as this file holds it.

    Args:
        folder: folder of the suite
        name: name of a made scene or a capture
        size: number of Gaussians of a made scene

    Raises:
        ProgdfError: the folder cannot be written to, or a capture is not the suite's.
    """
    path = folder / name / "scene.ply"
    if name in MADE:
        scene = MADE[name](size)
        write_scene(folder / name, scene)
    else:
        scene = CAPTURES[name].load()
        make_folder(folder / name)
        save_ply(path, scene.gaussians)
    return replace(scene, gaussians=load_ply(path))


def _within(points: Tensor, box: Box) -> Tensor:
    """Return which points [N,3] are inside a box. [N] bool"""
    corners = points.new_tensor(box)
    return ((points >= corners[:3]) & (points <= corners[3:])).all(dim=1)
