"""Pictures of the scene that any program has changed, each with the camera from which it was rendered.

    pictures:A.png[,B.png…]     the finished edit, from a handful of cameras
    0.5/A.png, 0.5/B.png, …     beside them: further strengths, a subfolder each

The run's views are these pictures' own (see `trainer.setup.training_setup`). What shows through the scene,
its background, may be of any one color: it is found, and taken for the run's; a shift by a pixel or two is
undone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import interpolate

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, Origin
from progdf.io.images import picture_size, read_picture, save_as
from progdf.io.picture_camera import find_picture_camera
from progdf.rasterize import render
from progdf.region import Region
from trainer.options import EditKind, EditorOptions
from trainer.views.view import BACKGROUND, View, seen_colors

MOST_PICTURES = 32
"""More are a folder of views: what a handful needs would take long."""

STEP = 1 / 255
"""What 8 bits, rounded on another machine, may differ by."""

_SHIFT = 2  # pixels by which a program may have moved the picture
STILL = 0.4  # quantile of the difference that tells how well a shift fits: much of a picture is unchanged
_EDGE = 0.02  # of color, from pixel to pixel: the rest fits anywhere
_BETTER = 0.8  # of the misfit as it is: noise alone makes one shift a little better than another
_SKEWED = 0.02  # by which a picture may differ in its proportions from its camera


@dataclass(frozen=True)
class PicturesEditor:
    """Reads the changed pictures; see the module's head.

    Args:
        scene: the original
        files: name of the view → strength → picture
        stages: the strengths, ascending
    """

    scene: Gaussians
    files: Mapping[str, Mapping[float, Path]]
    stages: tuple[float, ...]
    kind: EditKind = "color"
    confined: bool = False

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`; ProgdfError where the picture is missing or broken.

        What was changed is taken at the picture's own size, then shrunk: a picture that is shrunk differs
        from a small render wherever the scene is fine.
        """
        if strength == 0.0:
            return view.image
        path, camera = self.files[view.camera.name][strength], view.camera
        original, picture = read_change(self.scene, path, camera.resize(*picture_size(path)))
        change = (lay_over(original, picture) - original).permute(2, 0, 1)[None]
        shrunk = interpolate(change, size=(camera.height, camera.width), mode="area")[0].permute(1, 2, 0)
        return (view.image + shrunk).clamp(0.0, 1.0)


def pictures(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], options: EditorOptions
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
    return PicturesEditor(scene, dict(zip(names, found, strict=True)), tuple(stages))


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
    sizes = [picture_size(path) for path in paths]
    cameras = rendered_cameras(paths, given, origin)
    return [camera.resize(*size) for camera, size in zip(cameras, sizes, strict=True)]


def rendered_cameras(paths: Sequence[Path], given: Sequence[Camera], origin: Origin = ZERO) -> list[Camera]:
    """`picture_cameras`, at the size at which each was rendered."""
    cameras = []
    for path in paths:
        camera = find_picture_camera(path, given, origin)
        width, height = picture_size(path)
        if abs(width * camera.height / (height * camera.width) - 1) > _SKEWED:
            raise ProgdfError(
                f"{path} is {width}x{height} pixels, it was rendered with {camera.width}x{camera.height}; "
                "keep the proportions, and crop nothing"
            )
        cameras.append(camera)
    return cameras


def read_change(scene: Gaussians, path: Path, camera: Camera) -> tuple[Tensor, Tensor]:
    """A changed picture, and the render that it was before, over the picture's own background.

    Args:
        scene: the original
        path: the picture
        camera: from which it was rendered, at the size at which it was

    Returns:
        original; picture. [H,W,3] each, of the picture's own size

    Raises:
        ProgdfError: it is missing or broken.
    """
    picture, run = read_picture(path), torch.tensor(BACKGROUND)
    size = (picture.shape[1], picture.shape[0])
    drawn, clear = _draw(scene, camera)
    background = background_of(picture, resize_image(drawn, size), resize_image(clear, size), save_as(path))
    original = resize_image((drawn + clear * (background - run)).clamp(0.0, 1.0), size)
    return original, picture


def picture_background(scene: Gaussians, path: Path, camera: Camera) -> Tensor:
    """The color behind a picture, rgb [3], found at the camera's size; see `read_change`."""
    picture = resize_image(read_picture(path), (camera.width, camera.height))
    return background_of(picture, *_draw(scene, camera), save_as(path))


def _draw(scene: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """The scene over the run's background, not clamped [H,W,3], and its transmittance [H,W,1]."""
    with torch.no_grad():
        drawn = render(scene, camera, BACKGROUND, colors=seen_colors(scene, camera))
    return drawn.image, drawn.transmittance[..., None]


def background_of(
    picture: Tensor, original: Tensor, clear: Tensor, save: Callable[[Tensor], Tensor]
) -> Tensor:
    """The color behind a picture: the one that leaves least of what tells it from the render.

    Args:
        picture: [H,W,3]
        original: the render over the run's background, not clamped. [H,W,3]
        clear: transmittance of the scene. [H,W,1]
        save: what saving makes of an image, see `save_as`

    Returns:
        rgb. [3]; the run's own background, unless another leaves half as much where the scene is clear
    """
    run, weight = torch.tensor(BACKGROUND), clear[..., 0].double()
    apart = picture - original
    shades = ((run + apart / clear.clamp_min(1e-6)) * 255.0).round().clamp(0, 255).long()
    # least Σ clear·|apart − clear·(color − run)| is the median with weights clear²
    colors = []
    for channel in range(3):
        counts = torch.bincount(shades[..., channel].flatten(), weight.square().flatten(), 256).cumsum(0)
        colors.append(int(torch.searchsorted(counts, 0.5 * counts[-1])) / 255.0)
    color = torch.tensor(colors)

    def misfit(background: Tensor) -> float:
        left = (apart - clear * (background - run)).abs()
        return float((weight[..., None] * left).sum())

    if misfit(color) >= 0.5 * misfit(run):
        return run
    # a JPEG has another color by a step, and so may have several
    near = [color + STEP * torch.tensor(step) for step in product((0, -1, 1), repeat=3)]
    errors = [float((save(before.expand(16, 16, 3)) - color).abs().amax()) for before in near]
    likely = [before for before, error in zip(near, errors, strict=True) if error <= min(errors)]

    def replayed(before: Tensor) -> float:
        over = (original + clear * (before - run)).clamp(0.0, 1.0)
        return float((save(over) - picture).abs().mean())

    return min(likely, key=replayed) if len(likely) > 1 else likely[0]


def resize_image(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Scaled to width and height as painting programs do it, by Lanczos. [H,W,C] -> [h,w,C]"""
    if (image.shape[1], image.shape[0]) == size:
        return image
    channels = [Image.fromarray(channel.numpy()) for channel in image.float().unbind(2)]
    scaled = [np.asarray(channel.resize(size, Image.Resampling.LANCZOS)) for channel in channels]
    return torch.from_numpy(np.stack(scaled, axis=2))


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
        return float(np.quantile(np.abs(found - expected).max(axis=1), STILL))

    if misfit((0, 0)) <= STEP:  # it lies where it lay
        return picture
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
