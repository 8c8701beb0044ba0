"""Pictures of the scene that any program has changed, each with the camera from which it was rendered.

    pictures:A.png[,B.png…]     the finished edit, from a handful of cameras
    0.5/A.png, 0.5/B.png, …     beside them: further strengths, a subfolder each

The run's views are these pictures' own (see `trainer.setup`). What shows through the scene,
its background, may be of any one color: it is found, and taken for the run's; a shift by a pixel or two is
undone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy import ndimage
from torch import Tensor

from progdf.camera import Camera, undistort
from progdf.color.edits import number_of, typical_color
from progdf.color.oklab import Bend, bend_of, interpolate_colors
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, Origin
from progdf.io.images import picture_size, read_picture, save_as
from progdf.io.picture_camera import find_picture_camera
from progdf.io.picture_files import PictureFolder, find_picture, name_key, split_path
from progdf.rasterize import render
from trainer.options import EditKind
from trainer.views.view import BACKGROUND, View, seen_colors, shrink_image

from .base import EditorInput

MAX_PICTURES = 32
"""More are a folder of views: what a handful needs would take long."""

_MIN_STRENGTHS = 8  # where several are given, those between them counted
STEP = 1 / 255
"""What 8 bits, rounded on another machine, may differ by."""

_SHIFT = 2  # pixels by which a program may have moved the picture
STILL = 0.4  # quantile of the difference that tells how well a shift fits: much of a picture is unchanged
_EDGE = 0.02  # of color, from pixel to pixel: the rest fits anywhere
_BETTER = 0.8  # of the misfit as it is: noise alone makes one shift a little better than another
_SKEWED = 0.02  # by which a picture may differ in its proportions from its camera


@dataclass(frozen=True)
class PicturesEditor:
    """The changed pictures, and what lies between them: straight in OKLab, with a bow (`bend_of`)."""

    given: Mapping[str, Mapping[float, Tensor]]  # view's name → strength, 0 among them → picture. [H,W,3]
    bends: Mapping[float, Bend]  # of the way to each strength from the one before
    stages: tuple[float, ...]  # ascending; empty where the finished edit alone is given
    kind: EditKind = "color"
    is_confined: bool = False

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        given = self.given[view.camera.name]
        if strength in given:
            return given[strength]
        before = max(s for s in given if s < strength)
        after = min(s for s in given if s > strength)
        share = (strength - before) / (after - before)
        return interpolate_colors(given[before], given[after], share, self.bends[after])


def pictures(given: EditorInput) -> PicturesEditor:
    """`pictures:A.png[,B.png…]`: see the module's head; the views are the pictures', in their order.

    Raises:
        ProgdfError: a picture is missing or broken.
    """
    found = [strengths_of(path) for path in picture_paths(given.what)]
    stages = sorted({strength for strengths in found for strength in strengths})
    for strengths in found:
        for strength in stages:
            if strength not in strengths:
                path = strengths[1.0].parent / f"{strength:g}" / strengths[1.0].name
                raise ProgdfError(f"{path} is missing; every picture needs one of each strength")
    images = {
        view.camera.name: {0.0: view.image}
        | {s: read_edit(given.scene, view.camera, view.image, path) for s, path in some.items()}
        for view, some in zip(given.views, found, strict=True)
    }
    bends = {}
    ways = list(pairwise((0.0, *stages)))
    for before, after in ways:
        first, last = (torch.cat([some[s] for some in images.values()]) for s in (before, after))
        weights = (last - first).norm(dim=2)
        bends[after] = bend_of(typical_color(first, weights), typical_color(last, weights))
    parts = -(-_MIN_STRENGTHS // len(stages))
    between = [a + (b - a) * (k + 1) / parts for a, b in ways for k in range(parts - 1)]
    return PicturesEditor(images, bends, tuple(sorted({*between, *stages})) if len(stages) > 1 else ())


def read_edit(scene: Gaussians, camera: Camera, image: Tensor, path: Path) -> Tensor:
    """The view `image` of a camera as a picture has changed it; ProgdfError where that is broken. [H,W,3]

    What was changed is taken at the picture's own size, then shrunk: a picture that is shrunk differs
    from a small render wherever the scene is fine.
    """
    original, picture = read_change(scene, path, camera.resize(*picture_size(path)))
    change = lay_over(original, picture) - original
    return (image + shrink_image(change, (camera.height, camera.width))).clamp(0.0, 1.0)


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
    if len(paths) > MAX_PICTURES:
        raise ProgdfError(
            f"pictures: takes at most {MAX_PICTURES} pictures, not {len(paths)}; "
            "give more as folder:DIR, of views that --cameras has"
        )
    return paths


def strengths_of(path: Path) -> dict[float, Path]:
    """Strength → picture: those of its name in subfolders that are named for one, and itself at 1."""
    paths = {1.0: path}
    for child in sorted(path.parent.iterdir()):
        strength = number_of(child.name)
        if not math.isfinite(strength):
            continue
        picture = find_picture(child, path.name)
        if picture is None:
            continue
        if not 0.0 < strength < 1.0:
            raise ProgdfError(
                f"{child} is named for a strength that is not between 0 and 1; name it 0.25, 0.5, …"
            )
        paths[strength] = picture
    return paths


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
    picture = read_picture(path)
    run = torch.tensor(BACKGROUND)
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

    def replay_error(before: Tensor) -> float:
        over = (original + clear * (before - run)).clamp(0.0, 1.0)
        return float((save(over) - picture).abs().mean())

    return min(likely, key=replay_error) if len(likely) > 1 else likely[0]


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
        shifted = b[(rows - shift[0]).clip(0, height - 1), (columns - shift[1]).clip(0, width - 1)]
        return float(np.quantile(np.abs(shifted - expected).max(axis=1), STILL))

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


_EDITED = "put the edited copies of RUN/views/original/*.png there, under the same names"
_TAKEN = "put the photographs there, under the names that the cameras have"


@dataclass(frozen=True)
class FolderEditor:
    """Reads edited views from one folder per strength."""

    folders: Mapping[float, PictureFolder]  # strength → folder
    stages: tuple[float, ...]  # the strengths, ascending
    kind: EditKind = "style"
    is_confined: bool = False
    bent: bool = False  # the pictures were taken through the views' lenses and are to be straightened
    # where the unedited photographs lie, if the views are to be changed as these were; else the pictures are
    # taken as they are
    originals: PictureFolder | None = None

    @property
    def note(self) -> str | None:
        """What the person should know before training, if anything."""
        if not self.bent or self.originals is not None:
            return None
        return (
            "photographs: without the unedited photographs, what the scene shows otherwise than they do is "
            "trained as part of the edit; name their folder too, photographs:EDITED,ORIGINALS"
        )

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`; ProgdfError where the picture is missing, broken or of another shape."""
        if strength == 0.0:
            return view.image
        picture, visible = self._read_undistorted(self.folders[strength], view)
        if self.originals is not None:
            picture = (view.image + picture - self._read_undistorted(self.originals, view)[0]).clamp(0.0, 1.0)
        return torch.where(visible[..., None], picture, view.image)

    def _read_undistorted(self, pictures: PictureFolder, view: View) -> tuple[Tensor, Tensor]:
        """Return a picture at its view's size, straight, and the pixels it covers. [H,W,3], [H,W] bool"""
        camera = view.camera
        path = pictures.require(camera.name, _advice(self.bent))
        picture = read_picture(path, (camera.width, camera.height), calibrated=self.bent)
        if not self.bent or camera.lens is None:
            return picture, torch.ones_like(picture[..., 0], dtype=torch.bool)
        return undistort(picture, camera.K, camera.lens)


def folder_of(what: str) -> Path:
    """The DIR of `folder:DIR`; ProgdfError where there is no such folder."""
    if not what:
        raise ProgdfError("folder: needs a folder; write folder:DIR with the edited views in DIR")
    root = Path(what).expanduser()
    if not root.is_dir():
        raise ProgdfError(f"{root} is not a folder; {_EDITED}")
    return root


def photograph_folders(what: str) -> tuple[Path, Path | None]:
    """EDITED and ORIGINALS of `photographs:EDITED,ORIGINALS`; ProgdfError where one is no folder."""
    edited, comma, originals = what.rpartition(",")
    names = [edited, originals] if comma and not Path(what).expanduser().is_dir() else [what]
    roots = [Path(name).expanduser() for name in names]
    for name, root in zip(names, roots, strict=True):
        if not name:
            raise ProgdfError("photographs: needs a folder; write photographs:EDITED,ORIGINALS")
        if not root.is_dir():
            raise ProgdfError(f"{root} is not a folder; {_TAKEN}")
    return roots[0], roots[1] if len(roots) > 1 else None


def folder(given: EditorInput) -> FolderEditor:
    """`folder:DIR`: see the module's head. Every view's picture is looked for before training starts."""
    return _make_editor(folder_of(given.what), given.views)


def _make_editor(root: Path, views: Sequence[View], bent: bool = False) -> FolderEditor:
    """Return the editor of a folder, after every view's picture was found.

    A subfolder named by a number holds a strength, unless views are named after it: `1/IMG.png`.
    """
    names = [view.camera.name for view in views]
    view_folders = {name_key(split_path(name)[0]) for name in names if "/" in name}
    paths: dict[float, Path] = {}
    for child in sorted(root.iterdir()):
        strength = number_of(child.name)
        if not child.is_dir() or not math.isfinite(strength) or name_key(child.name) in view_folders:
            continue
        if not 0.0 < strength <= 1.0:
            raise ProgdfError(f"{child} is named for a strength outside 0..1; name it 0.25, 0.5, … or 1")
        paths[strength] = child
    paths.setdefault(1.0, root)
    folders = {strength: _check_pictures(path, names, bent) for strength, path in paths.items()}
    return FolderEditor(folders, tuple(sorted(folders)), bent=bent)


def photographs(given: EditorInput) -> FolderEditor:
    """`photographs:EDITED,ORIGINALS` or `photographs:EDITED`: see the module's head."""
    edited, originals = photograph_folders(given.what)
    editor = _make_editor(edited, given.views, bent=True)
    if originals is None:
        return editor
    names = [view.camera.name for view in given.views]
    return replace(editor, originals=_check_pictures(originals, names, bent=True))


def _check_pictures(folder: Path, names: Sequence[str], bent: bool) -> PictureFolder:
    """Return a folder that has a picture of every view.

    Raises:
        ProgdfError: a picture is missing, or two have the name of one view.
    """
    pictures = PictureFolder(folder, names)
    for name in names:
        pictures.require(name, _advice(bent))
    return pictures


def _advice(bent: bool) -> str:
    return _TAKEN if bent else _EDITED
