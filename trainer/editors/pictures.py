"""Pictures of the scene that any program has changed, each with the camera from which it was rendered.

    pictures:A.png[,B.png…]     the finished edit, from a handful of cameras
    0.5/A.png, 0.5/B.png, …     beside them: further strengths, a subfolder each

The run's views are these pictures' own (see `trainer.setup.training_setup`). What shows through the scene,
its background, may be of any one color: it is found, and taken for the run's; a shift by a pixel or two is
undone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, Origin
from progdf.io.images import picture_size, read_picture
from progdf.io.picture_camera import find_picture_camera
from progdf.rasterize import render
from progdf.region import Region
from trainer.views.view import BACKGROUND, View

from .base import EditKind, EditorSettings

MOST_PICTURES = 32
"""More are a folder of views: what a handful needs would take long."""

_CLEAR, _LEAST_CLEAR = 0.98, 0.002  # transmittance of a pixel of the background; share of those that tell
_SHIFT = 2  # pixels by which a program may have moved the picture
_STILL = 0.4  # quantile of the difference that tells how well a shift fits: much of a picture is unchanged
_EDGE = 0.02  # of color, from pixel to pixel: the rest fits anywhere
_BETTER = 0.8  # of the misfit as it is: noise alone makes one shift a little better than another
_SKEWED = 0.02  # by which a picture may differ in its proportions from its camera


@dataclass(frozen=True)
class PicturesEditor:
    """Reads the changed pictures; see the module's head.

    Args:
        files: name of the view → strength → picture
        clear: name of the view → transmittance of the scene there. [H,W]
        stages: the strengths, ascending
    """

    files: Mapping[str, Mapping[float, Path]]
    clear: Mapping[str, Tensor]
    stages: tuple[float, ...]
    kind: EditKind = "color"
    confined: bool = False

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`; ProgdfError where the picture is missing, broken or of another shape."""
        if strength == 0.0:
            return view.image
        name, camera = view.camera.name, view.camera
        picture = read_picture(self.files[name][strength], size=(camera.width, camera.height))
        return lay_over(view.image, mend_background(picture, self.clear[name]))


def pictures(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> PicturesEditor:
    """`pictures:A.png[,B.png…]`: see the module's head; the views are the pictures', in their order."""
    found = [strengths_of(path) for path in picture_paths(what)]
    stages = sorted({strength for strengths in found for strength in strengths})
    for strengths in found:
        for strength in stages:
            if strength not in strengths:
                path = strengths[1.0].parent / f"{strength:g}" / strengths[1.0].name
                raise ProgdfError(f"{path} is missing; every picture needs one of each strength")
    names = [view.camera.name for view in views]
    clear = [transmittance(scene, view.camera) for view in views]
    return PicturesEditor(
        dict(zip(names, found, strict=True)), dict(zip(names, clear, strict=True)), tuple(stages)
    )


def picture_paths(what: str) -> tuple[Path, ...]:
    """The pictures of `pictures:A.png[,B.png…]`; ProgdfError where one is missing, or two have one name."""
    names = [what] if Path(what).expanduser().is_file() else [name.strip() for name in what.split(",")]
    paths = tuple(Path(name).expanduser() for name in names)
    for name, path in zip(names, paths, strict=True):
        if not name:
            raise ProgdfError("pictures: needs a picture; write pictures:A.png,B.png")
        if not path.is_file():
            reason = "is a folder" if path.is_dir() else "does not exist"
            raise ProgdfError(f"{path} {reason}; give the pictures that were changed, pictures:A.png,B.png")
    stems = [path.stem for path in paths]
    for stem in stems:
        if stems.count(stem) > 1:
            raise ProgdfError(f"two pictures are named {stem}; name them differently")
    if len(paths) > MOST_PICTURES:
        raise ProgdfError(
            f"pictures: takes at most {MOST_PICTURES} pictures, not {len(paths)}; "
            "give more as folder:DIR, of views that --cameras has"
        )
    return paths


def strengths_of(path: Path) -> dict[float, Path]:
    """Strength → picture: those of its name in subfolders that are named for one, and itself at 1."""
    found = {1.0: path}
    for child in sorted(path.parent.iterdir()):
        try:
            strength = float(child.name)
        except ValueError:
            continue
        if math.isfinite(strength) and (child / path.name).is_file():
            if not 0.0 < strength < 1.0:
                raise ProgdfError(
                    f"{child} is named for a strength that is not between 0 and 1; name it 0.25, 0.5, …"
                )
            found[strength] = child / path.name
    return found


def picture_cameras(paths: Sequence[Path], given: Sequence[Camera], origin: Origin = ZERO) -> list[Camera]:
    """The cameras of the pictures, at their size; `origin`: of the scene, which they are relative to.

    Raises:
        ProgdfError: none is found for one, see `find_picture_camera`, or its proportions are another's.
    """
    cameras = []
    for path in paths:
        camera = find_picture_camera(path, given, origin)
        width, height = picture_size(path)
        if abs(width * camera.height / (height * camera.width) - 1) > _SKEWED:
            raise ProgdfError(
                f"{path} is {width}x{height} pixels, it was rendered with {camera.width}x{camera.height}; "
                "keep the proportions, and crop nothing"
            )
        cameras.append(camera.resize(width, height))
    return cameras


def transmittance(scene: Gaussians, camera: Camera) -> Tensor:
    """How much of the background shines through each pixel. [H,W] 0..1"""
    with torch.no_grad():
        return render(scene, camera, BACKGROUND).transmittance


def mend_background(picture: Tensor, clear: Tensor) -> Tensor:
    """The picture with the run's background in place of its own, which is the color of what is clear.

    Args:
        picture: [H,W,3]
        clear: see `transmittance`. [H,W]
    """
    empty = clear > _CLEAR
    if float(empty.float().mean()) < _LEAST_CLEAR:
        return picture
    own = picture[empty].median(dim=0).values
    return (picture + clear[..., None] * (torch.tensor(BACKGROUND) - own)).clamp(0.0, 1.0)


def lay_over(original: Tensor, picture: Tensor) -> Tensor:
    """The picture moved back by the pixels, up to two, that a program has moved it by. [H,W,3] each"""
    a, b = (ndimage.uniform_filter(image.numpy(), (3, 3, 1)) for image in (original, picture))
    steps = [np.abs(move_image(a, shift) - a).max(axis=2) for shift in ((0, 1), (1, 0))]
    edges = np.max(steps, axis=0) > _EDGE
    if not edges.any():
        return picture
    reach = range(-_SHIFT, _SHIFT + 1)
    shifts = sorted(((y, x) for y in reach for x in reach), key=lambda shift: abs(shift[0]) + abs(shift[1]))

    rows, columns = np.nonzero(edges)
    expected, (height, width) = a[rows, columns], edges.shape

    def misfit(shift: tuple[int, int]) -> float:
        found = b[(rows - shift[0]).clip(0, height - 1), (columns - shift[1]).clip(0, width - 1)]
        return float(np.quantile(np.abs(found - expected).max(axis=1), _STILL))

    errors = [misfit(shift) for shift in shifts]
    best = int(np.argmin(errors))
    if errors[best] >= _BETTER * errors[0]:
        return picture
    return torch.from_numpy(move_image(picture.numpy(), shifts[best]))


def move_image(image: np.ndarray, shift: tuple[int, int]) -> np.ndarray:
    """The image moved by rows and columns, its rim repeated. [H,W,3]"""
    height, width = image.shape[:2]
    rows = (np.arange(height) - shift[0]).clip(0, height - 1)
    columns = (np.arange(width) - shift[1]).clip(0, width - 1)
    moved: np.ndarray = image[rows][:, columns]
    return moved
