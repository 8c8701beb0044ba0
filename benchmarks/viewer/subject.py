"""The benchmark `subject`: overlap of the selected subject with labels, from several views of each scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from benchmarks.courses import processor_milliseconds
from benchmarks.table import Table, machine
from progdf.camera import Camera
from progdf.demo_scenes.bear import LABELS, bear
from progdf.errors import ProgdfError
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians
from progdf.rasterize import render
from progdf.scene.neighbors import Neighborhood
from progdf.scene.regions import read_labels
from progdf.scene.selection import Mask
from progdf.scene.subject import select_subject
from progdf.scene.up_axis import guess_up
from progdf.sh import rgb_to_sh0, sh0_to_rgb
from progdf.terminal import group_digits
from viewer.camera.view_camera import ViewCamera, add_scaled, axes, first_camera, to_camera

SIZE = (1280, 800)  # width and height of the views, pixels
PICTURE_PX = (320, 200)  # width and height of a view in the sheet, pixels
LABELS_SUFFIX = "_labels.npy"
"""End of the file of labels beside a scene; its subject has the labels above 0."""
_SUPPORTS = ("plinth", "grass")  # parts of the demo scene that are not its subject
_TINT = torch.tensor([1.0, 0.55, 0.05])  # color of the selection in the pictures, sRGB
_DIMMED = 0.35  # brightness of Gaussians outside the selection


@dataclass(frozen=True)
class SubjectView:
    """View relative to the first one of a scene."""

    name: str
    turn: float = 0.0  # added azimuth, degrees
    rise: float = 0.0  # added elevation, degrees
    shift: tuple[float, float] = (0.0, 0.0)  # shift of the pivot, right and up, in heights of the picture
    distance: float = 1.0  # camera distance, as a multiple of the first view's


VIEWS = (
    SubjectView("front"),
    SubjectView("behind", turn=120.0, rise=15.0),
    SubjectView("closer, off center", turn=60.0, shift=(0.2, 0.0), distance=0.6),
    SubjectView("farther, off center", turn=200.0, rise=-5.0, shift=(-0.2, 0.2), distance=1.5),
)


def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Measure the selected subject of the demo scene, or of scenes with labels beside them.

    Args:
        scenes: scenes; SCENE_labels.npy beside each holds one integer per Gaussian, above 0 for its subject
        plot: file of a sheet of pictures with the selections, one row per scene

    Raises:
        ProgdfError: a file is missing or invalid.
    """
    rows = []
    sheet = []
    for name, scene, truth in _labeled(scenes):
        up = guess_up(scene)
        neighborhood = Neighborhood(scene)
        prepared = processor_milliseconds(lambda: neighborhood.scribbles)  # noqa: B023
        overlaps = []
        seconds = []
        pictures = []
        for view in VIEWS:
            camera = to_camera(_moved(first_camera(scene), view), *SIZE)
            found: list[Mask] = []
            seconds.append(
                processor_milliseconds(
                    lambda: found.append(select_subject(scene, neighborhood, camera, up))  # noqa: B023
                )
            )
            overlaps.append(f"{(found[0] & truth).sum() / (found[0] | truth).sum():.3f}")
            pictures.append(_picture(scene, found[0], camera))
        rows.append(
            (
                name,
                group_digits(len(scene)),
                *overlaps,
                f"{prepared / 1000:.1f}",
                f"{max(seconds) / 1000:.1f}",
            )
        )
        sheet.append(np.concatenate(pictures, axis=1))
    if plot is not None:
        Image.fromarray(np.concatenate(sheet)).save(plot)
    heads = ("scene", "Gaussians", *(view.name for view in VIEWS), "preparing once, s", "selecting, s")
    note = f"Intersection over union of Gaussians; processor time, slowest view. {machine()}."
    return [Table("subject", "Subject of a view", heads, tuple(rows), note)]


def _labeled(paths: Sequence[Path]) -> list[tuple[str, Gaussians, Mask]]:
    """Return the name, the scene and the mask of the subject of each scene; the demo scene without paths."""
    if not paths:
        demo = bear()
        support = torch.tensor([LABELS.index(name) for name in _SUPPORTS], dtype=demo.labels.dtype)
        return [("demo bear", demo.gaussians, ~torch.isin(demo.labels, support).numpy())]
    found = []
    for path in paths:
        name = path.name.split(".")[0]
        labels = path.with_name(name + LABELS_SUFFIX)
        if not labels.is_file():
            raise ProgdfError(f"{labels} does not exist; the subject is measured against labels")
        scene = load_scene(path)
        found.append((name, scene, (read_labels(str(labels), len(scene)) > 0).numpy()))
    return found


def _moved(first: ViewCamera, view: SubjectView) -> ViewCamera:
    """Return the first camera of a scene, moved to a view."""
    turned = replace(
        first,
        azimuth=first.azimuth + view.turn,
        elevation=first.elevation + view.rise,
        distance=first.distance * view.distance,
    )
    height = 2 * turned.distance * math.tan(math.radians(turned.fov_y / 2))
    along = axes(turned)
    right, up = (share * height for share in view.shift)
    return replace(turned, pivot=add_scaled(turned.pivot, (right, along.right), (up, along.up)))


def _picture(scene: Gaussians, mask: Mask, camera: Camera) -> NDArray[np.uint8]:
    """Return a small picture of a view with the selection tinted and everything else dimmed. [H,W,3]"""
    colors = sh0_to_rgb(scene.sh0).clamp(0.0, 1.0)
    inside = torch.from_numpy(mask)[:, None]
    tinted = torch.where(inside, 0.55 * colors + 0.45 * _TINT, _DIMMED * colors)
    painted = replace(scene, sh0=rgb_to_sh0(tinted), shN=scene.shN[:, :0])
    with torch.no_grad():
        image = render(painted, camera.resize(*PICTURE_PX), (0.12, 0.12, 0.13)).image
    pixels: NDArray[np.uint8] = (255 * image.clamp(0.0, 1.0)).round().to(torch.uint8).numpy()
    return pixels
