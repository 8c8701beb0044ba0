"""Editors that read edited pictures: `pictures`, `folder` and `photographs`.

    pictures:A.png[,B.png…]          the finished edit, rendered from a small number of cameras
    0.5/A.png, 0.5/B.png, …          beside them: further strengths, one subfolder each
    folder:DIR                       an edited copy of every view
    photographs:EDITED,ORIGINALS     edited photographs and, optionally, the unedited ones

A picture of `pictures` needs the camera that rendered it (see `trainer.views.picture_cameras`). The run's
views are then the views of these pictures. The background behind the scene can have any single color: it is
detected and replaced by the run's background. A shift by one or two pixels is undone.
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
from progdf.gaussians import Gaussians
from progdf.io.cameras import kind_of_cameras
from progdf.io.images import picture_size, read_picture, saving_loss
from progdf.io.picture_files import PictureFolder, find_picture, name_key, split_path
from progdf.rasterize import render
from trainer.options import EditKind
from trainer.views.view import BACKGROUND, View, shrink_image

from .base import EditorInput

MAX_PICTURES = 32
"""Maximum number of pictures. More belong in a folder of views: processing them here would be slow."""

_MIN_STRENGTHS = 8  # if several strengths are given, interpolate until there are this many
STEP = 1 / 255
"""Color difference that 8-bit rounding on another machine can cause."""

_MAX_SHIFT_PX = 2  # pixels; a program may have shifted the picture by this much
_BLOCK_PX = 17  # pixels; contains a JPEG block with subsampled chroma around its center
STILL = 0.4  # a shift is rated by this quantile of the differences; an edit may change the other pixels
_EDGE_CONTRAST = 0.02  # color difference of neighboring pixels at an edge; flat areas match at any shift
# share of the unshifted error that a shift must beat: noise alone favors one shift a little
_MAX_SHIFTED_ERROR = 0.8


@dataclass(frozen=True)
class PicturesEditor:
    """Editor that returns given pictures. Between their strengths it interpolates in OKLab (`bend_of`)."""

    given: Mapping[str, Mapping[float, Tensor]]  # view name → strength (0 included) → picture. [H,W,3]
    bends: Mapping[float, Bend]  # strength → bend of the color path from the strength before it
    stages: tuple[float, ...]  # ascending; empty if only the finished edit is given
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
    """Return the editor of `pictures:A.png[,B.png…]`.

    The views must be those of the pictures, in their order.

    Raises:
        ProgdfError: a picture is missing or broken.
    """
    paths_by_strength = [strengths_of(path) for path in picture_paths(given.what)]
    stages = sorted({strength for strengths in paths_by_strength for strength in strengths})
    for strengths in paths_by_strength:
        for strength in stages:
            if strength not in strengths:
                path = strengths[1.0].parent / f"{strength:g}" / strengths[1.0].name
                raise ProgdfError(f"{path} is missing; every picture needs a file for each strength")
    images = {
        view.camera.name: {0.0: view.image}
        | {
            s: read_edit(given.scene, view.camera, view.image, path, given.seen)
            for s, path in by_strength.items()
        }
        for view, by_strength in zip(given.views, paths_by_strength, strict=True)
    }
    bends = {}
    intervals = list(pairwise((0.0, *stages)))
    for before, after in intervals:
        first = torch.cat([by_strength[before] for by_strength in images.values()])
        last = torch.cat([by_strength[after] for by_strength in images.values()])
        weights = (last - first).norm(dim=2)
        bends[after] = bend_of(typical_color(first, weights), typical_color(last, weights))
    parts = -(-_MIN_STRENGTHS // len(stages))
    if len(stages) == 1:
        return PicturesEditor(images, bends, ())
    between = [a + (b - a) * (k + 1) / parts for a, b in intervals for k in range(parts - 1)]
    return PicturesEditor(images, bends, tuple(sorted({*between, *stages})))


def read_edit(
    scene: Gaussians, camera: Camera, image: Tensor, path: Path, seen: Gaussians | None = None
) -> Tensor:
    """Return the view `image` of a camera with the change of a picture applied. [H,W,3]

    The change is measured at the picture's own size and then shrunk. A shrunk picture differs from a small
    render wherever the scene has fine detail.

    Args:
        scene: scene of the view
        camera: camera of the view
        image: the view. [H,W,3]
        path: the picture
        seen: the scene that the picture shows, if it is another: the view takes painted pixels whole

    Raises:
        ProgdfError: the picture is broken.
    """
    full_camera = camera.resize(*picture_size(path))
    original, picture = read_change(scene if seen is None else seen, path, full_camera)
    change = undo_shift(original, picture) - original
    if seen is not None:
        loss = (saving_loss(path)(original) - original).abs().amax(dim=2).numpy()
        bound = torch.from_numpy(ndimage.maximum_filter(loss, _BLOCK_PX)) + STEP
        painted = change.abs().amax(dim=2, keepdim=True) > bound[..., None]
        change = change + painted * (original - read_change(scene, path, full_camera)[0])
    return (image + shrink_image(change, (camera.height, camera.width))).clamp(0.0, 1.0)


def picture_paths(what: str) -> tuple[Path, ...]:
    """Return the paths of pictures that are listed as `A.png[,B.png…]`, as in `pictures:` and `paint:`.

    Raises:
        ProgdfError: a picture is missing, two have the same name, or there are more than `MAX_PICTURES`.
    """
    names = [what] if Path(what).expanduser().is_file() else [name.strip() for name in what.split(",")]
    paths = tuple(Path(name).expanduser() for name in names)
    for name, path in zip(names, paths, strict=True):
        if not name:
            raise ProgdfError("the name of a picture is missing; list pictures as A.png,B.png")
        if not path.is_file():
            reason = "is a folder" if path.is_dir() else "does not exist"
            raise ProgdfError(f"{path} {reason}; list pictures as A.png,B.png")
    stems = [path.stem for path in paths]
    for stem in stems:
        if stems.count(stem) > 1:
            raise ProgdfError(f"two pictures are named {stem}; name them differently")
    if len(paths) > MAX_PICTURES:
        raise ProgdfError(
            f"at most {MAX_PICTURES} pictures can be listed, not {len(paths)}; "
            "give more changed pictures as folder:DIR, with their cameras in --cameras"
        )
    return paths


def removal_pictures(what: str) -> tuple[Path, ...]:
    """Return the paths of `remove:A.png[,B.png…]`, none for `remove`. Raises as `picture_paths`."""
    return picture_paths(what) if what else ()


def strengths_of(path: Path) -> dict[float, Path]:
    """Return the pictures of an edit by strength.

    The picture itself has strength 1. If a subfolder beside it is named by a number, the picture of the same
    name in it has that strength.

    Raises:
        ProgdfError: such a subfolder is named by a number that is not between 0 and 1.
    """
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


def read_change(scene: Gaussians, path: Path, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return a changed picture and the original render over the picture's own background.

    Args:
        scene: the original
        path: the picture
        camera: camera that rendered the picture, at the size of the render

    Returns:
        original; picture. [H,W,3] each, of the picture's own size

    Raises:
        ProgdfError: the picture is missing or broken.
    """
    picture = read_picture(path)
    run = torch.tensor(BACKGROUND)
    size = (picture.shape[1], picture.shape[0])
    drawn, clear = _draw(scene, camera)
    background = background_of(
        picture, resize_image(drawn, size), resize_image(clear, size), saving_loss(path)
    )
    original = resize_image((drawn + clear * (background - run)).clamp(0.0, 1.0), size)
    return original, picture


def picture_background(scene: Gaussians, path: Path, camera: Camera) -> Tensor:
    """Return the background color of a picture, found at the camera's size (see `read_change`). rgb [3]"""
    picture = resize_image(read_picture(path), (camera.width, camera.height))
    return background_of(picture, *_draw(scene, camera), saving_loss(path))


def _draw(scene: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the scene over the run's background, not clamped, and its transmittance. [H,W,3], [H,W,1]"""
    with torch.no_grad():
        drawn = render(scene, camera, BACKGROUND)
    return drawn.image, drawn.transmittance[..., None]


def background_of(
    picture: Tensor, original: Tensor, clear: Tensor, save: Callable[[Tensor], Tensor]
) -> Tensor:
    """Return the background color of a picture: the color that minimizes its difference to the render.

    Args:
        picture: [H,W,3]
        original: the render over the run's background, not clamped. [H,W,3]
        clear: transmittance of the scene. [H,W,1]
        save: returns an image as it is after saving and reading (see `saving_loss`)

    Returns:
        rgb [3]; the run's own background unless another color halves the error where the scene is
        transparent
    """
    run = torch.tensor(BACKGROUND)
    weight = clear[..., 0].double()
    difference = picture - original
    candidates = ((run + difference / clear.clamp_min(1e-6)) * 255.0).round().clamp(0, 255).long()
    # the minimum of Σ clear·|difference − clear·(color − run)| is the median with weights clear²
    colors = []
    for channel in range(3):
        counts = torch.bincount(candidates[..., channel].flatten(), weight.square().flatten(), 256).cumsum(0)
        colors.append(int(torch.searchsorted(counts, 0.5 * counts[-1])) / 255.0)
    color = torch.tensor(colors)

    def misfit(background: Tensor) -> float:
        remainder = (difference - clear * (background - run)).abs()
        return float((weight[..., None] * remainder).sum())

    if misfit(color) >= 0.5 * misfit(run):
        return run
    # JPEG can shift a color by one step, so several colors may become this one
    neighbors = [color + STEP * torch.tensor(step) for step in product((0, -1, 1), repeat=3)]
    errors = [float((save(before.expand(16, 16, 3)) - color).abs().amax()) for before in neighbors]
    best = [before for before, error in zip(neighbors, errors, strict=True) if error <= min(errors)]

    def replay_error(before: Tensor) -> float:
        replayed = (original + clear * (before - run)).clamp(0.0, 1.0)
        return float((save(replayed) - picture).abs().mean())

    return min(best, key=replay_error) if len(best) > 1 else best[0]


def resize_image(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize an image to a width and height by Lanczos, as painting programs do. [H,W,C] -> [h,w,C]"""
    if (image.shape[1], image.shape[0]) == size:
        return image
    channels = [Image.fromarray(channel.numpy()) for channel in image.float().unbind(2)]
    scaled = [np.asarray(channel.resize(size, Image.Resampling.LANCZOS)) for channel in channels]
    return torch.from_numpy(np.stack(scaled, axis=2))


def undo_shift(original: Tensor, picture: Tensor) -> Tensor:
    """Return the picture with a shift of up to two pixels undone. [H,W,3] each"""
    original_smooth = ndimage.uniform_filter(original.numpy(), (3, 3, 1))
    picture_smooth = ndimage.uniform_filter(picture.numpy(), (3, 3, 1))
    steps = [
        np.abs(move_image(original_smooth, shift) - original_smooth).max(axis=2) for shift in ((0, 1), (1, 0))
    ]
    edges = np.max(steps, axis=0) > _EDGE_CONTRAST
    if not edges.any():
        return picture
    offsets = range(-_MAX_SHIFT_PX, _MAX_SHIFT_PX + 1)
    shifts = sorted(
        ((y, x) for y in offsets for x in offsets), key=lambda shift: abs(shift[0]) + abs(shift[1])
    )

    rows, columns = np.nonzero(edges)
    expected = original_smooth[rows, columns]
    height, width = edges.shape

    def misfit(shift: tuple[int, int]) -> float:
        shifted = picture_smooth[
            (rows - shift[0]).clip(0, height - 1), (columns - shift[1]).clip(0, width - 1)
        ]
        return float(np.quantile(np.abs(shifted - expected).max(axis=1), STILL))

    if misfit((0, 0)) <= STEP:  # the picture is not shifted
        return picture
    errors = [misfit(shift) for shift in shifts]
    best = int(np.argmin(errors))
    if errors[best] >= _MAX_SHIFTED_ERROR * errors[0]:
        return picture
    return torch.from_numpy(move_image(picture.numpy(), shifts[best]))


def move_image(image: np.ndarray, shift: tuple[int, int]) -> np.ndarray:
    """Return the image moved by (rows, columns), with its border repeated. [H,W,3]"""
    height, width = image.shape[:2]
    rows = (np.arange(height) - shift[0]).clip(0, height - 1)
    columns = (np.arange(width) - shift[1]).clip(0, width - 1)
    moved: np.ndarray = image[rows][:, columns]
    return moved


_EDITED_ADVICE = "put edited copies of the views of a run or of progdf views there, under the same names"
_PHOTOGRAPH_ADVICE = "put the photographs there, under the names of their cameras"


@dataclass(frozen=True)
class FolderEditor:
    """Editor that reads edited views from one folder per strength."""

    folders: Mapping[float, PictureFolder]  # strength → folder
    stages: tuple[float, ...]  # the strengths, ascending
    kind: EditKind = "style"
    is_confined: bool = False
    bent: bool = False  # the pictures have the lens distortion of their cameras and must be undistorted
    # Folder of the unedited photographs. The difference to them is added to the views. None: the pictures
    # replace the views.
    originals: PictureFolder | None = None

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`.

        Raises:
            ProgdfError: the picture is missing, broken or has a different shape.
        """
        if strength == 0.0:
            return view.image
        picture, visible = self._read_undistorted(self.folders[strength], view)
        if self.originals is not None:
            picture = (view.image + picture - self._read_undistorted(self.originals, view)[0]).clamp(0.0, 1.0)
        return torch.where(visible[..., None], picture, view.image)

    def _read_undistorted(self, pictures: PictureFolder, view: View) -> tuple[Tensor, Tensor]:
        """Return an undistorted picture at its view's size and the pixels it covers. [H,W,3], [H,W] bool"""
        camera = view.camera
        path = pictures.require(camera.name, _advice(self.bent))
        picture = read_picture(path, (camera.width, camera.height), calibrated=self.bent)
        if not self.bent or camera.lens is None:
            return picture, torch.ones_like(picture[..., 0], dtype=torch.bool)
        return undistort(picture, camera.K, camera.lens)


def folder_of(what: str) -> Path:
    """Return the folder of `folder:DIR`.

    Raises:
        ProgdfError: the folder does not exist.
    """
    if not what:
        raise ProgdfError("folder: needs a folder; write folder:DIR with the edited views in DIR")
    root = Path(what).expanduser()
    if not root.is_dir():
        raise ProgdfError(f"{root} is not a folder; {_EDITED_ADVICE}")
    return root


def photograph_folders(what: str) -> tuple[Path, Path | None]:
    """Return the folders of `photographs:EDITED,ORIGINALS`; None for ORIGINALS if it is not given.

    Raises:
        ProgdfError: one of them is not a folder.
    """
    edited, comma, originals = what.rpartition(",")
    names = [edited, originals] if comma and not Path(what).expanduser().is_dir() else [what]
    roots = [Path(name).expanduser() for name in names]
    for name, root in zip(names, roots, strict=True):
        if not name:
            raise ProgdfError("photographs: needs a folder; write photographs:EDITED,ORIGINALS")
        if not root.is_dir():
            raise ProgdfError(f"{root} is not a folder; {_PHOTOGRAPH_ADVICE}")
    return roots[0], roots[1] if len(roots) > 1 else None


def photographs_note(what: str) -> str:
    """Return a warning if `photographs:EDITED` has no unedited photographs, else an empty text."""
    if photograph_folders(what)[1] is not None:
        return ""
    return (
        "photographs: without the unedited photographs, differences between scene and photographs are "
        "trained as part of the edit; add their folder, photographs:EDITED,ORIGINALS"
    )


def folder_cameras(what: str) -> Path | None:
    """Return the cameras.json of a run or `progdf views` beside the pictures of `folder:DIR`; None if there
    is none."""
    root = Path(what)
    candidates = (place / "cameras.json" for place in (root, *root.absolute().parents[:2]))
    return next((path for path in candidates if path.is_file() and kind_of_cameras(path) == "own"), None)


def folder(given: EditorInput) -> FolderEditor:
    """Return the editor of `folder:DIR`. Every view must have a picture."""
    return _make_editor(folder_of(given.what), given.views)


def _make_editor(root: Path, views: Sequence[View], bent: bool = False) -> FolderEditor:
    """Return the editor of a folder after checking that every view has a picture.

    A subfolder named by a number holds a strength, unless view names contain it, as in `1/IMG.png`.
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
    """Return the editor of `photographs:EDITED,ORIGINALS` or `photographs:EDITED`."""
    edited, originals = photograph_folders(given.what)
    editor = _make_editor(edited, given.views, bent=True)
    if originals is None:
        return editor
    names = [view.camera.name for view in given.views]
    return replace(editor, originals=_check_pictures(originals, names, bent=True))


def _check_pictures(folder: Path, names: Sequence[str], bent: bool) -> PictureFolder:
    """Return a folder after checking that it has a picture of every view.

    Raises:
        ProgdfError: a picture is missing, or two pictures match one view.
    """
    pictures = PictureFolder(folder, names)
    for name in names:
        pictures.require(name, _advice(bent))
    return pictures


def _advice(bent: bool) -> str:
    return _PHOTOGRAPH_ADVICE if bent else _EDITED_ADVICE
