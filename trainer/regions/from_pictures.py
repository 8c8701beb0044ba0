"""Regions from pictures: masks:DIR, photomasks:DIR, scribbles:A.png, text:"…" and changed."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from rich.progress import track
from torch import Tensor

from progdf.camera import Camera, undistort
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians
from progdf.io.cameras import load_cameras, save_cameras
from progdf.io.images import read_mask
from progdf.io.picture_files import PictureFolder
from progdf.region import Region, from_mask, whole_scene
from progdf.scene.bounds import is_surrounding
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.regions import Check, Kind
from progdf.scene.scribbles import Rows, Scribbles, rows_under
from progdf.scene.selection import Surface, base_colors
from progdf.scene.up_axis import find_up
from trainer.editors.cache import PictureCache, Recipe
from trainer.editors.pictures import picture_paths, read_change
from trainer.options import VIEWS, RegionOptions, TrainingViewOptions
from trainer.store.pretrained import last_model
from trainer.views.choose import load_given_cameras
from trainer.views.lower_layers import check_lower_layers, open_lower_layers
from trainer.views.picture_cameras import rendered_cameras
from trainer.views.view import (
    BACKGROUND,
    fit_size,
    name_cameras,
    region_rig,
    render_view,
    shrink_image,
    with_near_plane,
)

from .changed import LIFTED_AT, changed_region
from .lift import lift_masks
from .segment import SEGMENTER_CHECKS, SEGMENTERS, Segmenter


def read_masks(folder: Path, cameras: Sequence[Camera], bent: bool = False) -> list[Tensor | None]:
    """Return the mask of every camera, scaled to its size; None if it has none. [H,W] float32, 0 to 1

    Args:
        folder: folder of the masks, see `PictureFolder`
        cameras: cameras with the names of their views
        bent: the masks were drawn over photographs with lens distortion, so undistort them

    Raises:
        ProgdfError: the folder has no mask, two of one view, a broken one, or one with other proportions.
    """
    pictures = PictureFolder(folder, [camera.name for camera in cameras])
    files = [pictures.find(camera.name) for camera in cameras]
    if not any(files):
        for camera in cameras:
            pictures.check_unread(camera.name)
        raise ProgdfError(
            f"{folder} has no mask for any of the {len(cameras)} cameras; "
            f"name each as its view, as {cameras[0].name}.png"
        )
    pairs = zip(files, cameras, strict=True)
    return [None if file is None else _mask(file, camera, bent) for file, camera in pairs]


def _mask(path: Path, camera: Camera, bent: bool) -> Tensor:
    """Return the undistorted mask of a camera at its size. [H,W] float32, 0 to 1"""
    mask = read_mask(path, (camera.width, camera.height), calibrated=bent)
    if bent and camera.lens:
        return undistort(mask[..., None].expand(-1, -1, 3), camera.K, camera.lens)[0][..., 0]
    return mask


CHANGED = "changed"
"""Name of the region found in changed pictures."""

# minimum color difference between a stroke and the render, and between its main channel and the other two
_STROKE_COLOR = 0.25


@dataclass(frozen=True)
class RegionRequest:
    """Request for a region from pictures."""

    options: RegionOptions
    # cameras and number of the segmented views; without cameras, the same number of closer views is added
    views: TrainingViewOptions
    cache: Callable[[], Path]  # creates and returns the folder for segmentation masks
    quiet: bool = False  # no progress on the screen
    say: Callable[[str], None] | None = None  # receives log lines about the masks

    @property
    def count(self) -> int:
        """Number of views to segment."""
        return self.views.views or VIEWS

    def up_of(self, scene: Gaussians) -> Tensor:
        """Return the up direction of a scene without cameras. [3]"""
        return find_up(scene, (), self.views.up, self.views.scene).direction


def region_kinds(request: RegionRequest) -> dict[str, Kind]:
    """Return the kinds of region from pictures, for `parse_region`.

    masks:DIR are drawn over undistorted pictures, such as RUN/views/original. photomasks:DIR are drawn over
    photographs, and are undistorted if the cameras have lenses. scribbles:A.png has green strokes on an
    object and red ones beside it, painted on rendered views. `changed` is the area where pictures differ from
    the scene.
    """

    def from_folder(text: str, scene: Gaussians, bent: bool) -> Region:
        kind = "photomasks" if bent else "masks"
        folder, file = _mask_folder(kind, text, request)
        cameras = _cameras(file, scene, request)
        masks = read_masks(folder, cameras, bent)
        count = sum(mask is not None for mask in masks)
        if not any(bool(mask.any()) for mask in masks if mask is not None):
            raise ProgdfError(
                f"none of the {count} masks in {folder} has a bright pixel; paint the object white on black"
            )
        if request.say is not None and count < len(masks):
            request.say(f"{count} of {len(masks)} cameras have a mask; the others are ignored")
        return _lift(scene, cameras, masks, f"{kind}:{text}", request)

    def from_text(text: str, scene: Gaussians) -> Region:
        prompt = _prompt(text)
        folder = request.cache() / _slug(prompt)
        cameras = _segmented_cameras(scene, request)
        masks = _segment(scene, cameras, prompt, folder, request)
        nonempty = _masks_with_pixels(masks, prompt, request)
        if request.views.cameras is None:
            # In views of the whole scene an object may be only a few pixels wide, so segment again in views
            # that it fills. With masks of the bear's body one pixel too wide or too narrow, IoU is 0.93
            # instead of 0.61 to 0.68.
            nearer = _near_cameras(scene, _lift(scene, cameras, nonempty, prompt, request), request)
            masks = [*masks, *_segment(scene, nearer, prompt, folder, request)]
            cameras = [*cameras, *nearer]
            nonempty = _masks_with_pixels(masks, prompt, request)
        # with the cameras, the folder can be used as masks:DIR for the same region
        telling = [camera for camera, mask in zip(cameras, nonempty, strict=True) if mask is not None]
        save_cameras(folder / "cameras.json", telling, scene.origin)
        return _lift(scene, cameras, nonempty, f"text:{prompt}", request)

    return {
        "masks": lambda text, scene: from_folder(text, scene, bent=False),
        "photomasks": lambda text, scene: from_folder(text, scene, bent=True),
        "text": from_text,
        "scribbles": lambda text, scene: _scribbles_region(text, scene, request),
        CHANGED: lambda text, scene: _find_changed(text, request, scene),
    }


def region_checks(request: RegionRequest) -> dict[str, Check]:
    """Return the checks that run before the scene is loaded, by kind of region, for `check_region`."""

    def of_text(text: str) -> None:
        _prompt(text)
        SEGMENTER_CHECKS["text"](request.options)

    return {
        "masks": lambda text: load_cameras(_mask_folder("masks", text, request)[1], ZERO),
        "photomasks": lambda text: load_cameras(_mask_folder("photomasks", text, request)[1], ZERO),
        "text": of_text,
        "scribbles": lambda text: _scribble_pictures(text, request),
        CHANGED: lambda text: check_lower_layers(_changed_pictures(text, request)[0], request.views.scene),
    }


def _find_changed(text: str, request: RegionRequest, scene: Gaussians) -> Region:
    """Return the region that changed pictures show."""
    paths, cameras = _changed_pictures(text, request, scene)
    lower = open_lower_layers(paths, request.views.scene, scene)
    threshold = request.options.lift_threshold
    if lower is None:
        return changed_region(scene, paths, cameras, threshold, request.say)
    return changed_region(lower.base, paths, cameras, threshold, request.say, lower.seen)


def _changed_pictures(
    text: str, request: RegionRequest, scene: Gaussians | None = None
) -> tuple[Sequence[Path], Sequence[Camera]]:
    """Return the pictures of `changed:A.png,B.png`, by default those of the editor, and their cameras."""
    paths = picture_paths(text) if text else request.views.pictures
    if not paths:
        raise ProgdfError(
            "changed needs pictures: use it with --editor pictures:A.png, or name them, changed:A.png,B.png"
        )
    return paths, _taken_from(paths, request, scene)


def _taken_from(paths: Sequence[Path], request: RegionRequest, scene: Gaussians | None) -> list[Camera]:
    """Return the cameras of rendered pictures. Without a scene they are not converted to its frame."""
    if scene is not None:
        return rendered_cameras(paths, load_given_cameras(request.views, scene).cameras, scene.origin)
    given = [] if request.views.cameras is None else load_cameras(request.views.cameras, ZERO)
    return rendered_cameras(paths, given, ZERO)


def _scribble_pictures(
    text: str, request: RegionRequest, scene: Gaussians | None = None
) -> tuple[list[Path], list[Camera]]:
    """Return the pictures of `scribbles:A.png,B.png`, and their cameras."""
    if not text:
        raise ProgdfError(
            "scribbles: needs rendered views with green strokes on the object and red ones beside it; "
            "write scribbles:A.png,B.png"
        )
    paths = list(picture_paths(text))
    return paths, _taken_from(paths, request, scene)


def _scribbles_region(text: str, scene: Gaussians, request: RegionRequest) -> Region:
    """Return the region of the object under green strokes, without the parts under red ones."""
    rows: dict[str, list[Rows]] = {"green": [], "red": []}
    for path, camera in zip(*_scribble_pictures(text, request, scene), strict=True):
        original, picture = read_change(scene, path, camera)
        surface = Surface(scene, replace(camera.resize(picture.shape[1], picture.shape[0]), lens=None))
        stroke = (picture - original).abs().amax(dim=-1) > _STROKE_COLOR
        red, green, blue = picture.unbind(dim=-1)
        for color, primary, other in (("green", green, red), ("red", red, green)):
            painted = stroke & (primary - torch.maximum(other, blue) > _STROKE_COLOR)
            rows[color].append(rows_under(painted.numpy(), surface))
    inside, outside = (np.concatenate(parts) for parts in rows.values())
    for color, found, where in (("green", inside, "on"), ("red", outside, "beside")):
        if not len(found):
            raise ProgdfError(f"no {color} stroke in {text} lies on the scene; paint one {where} the object")
    scribbles = Scribbles(scene.means.nan_to_num().numpy(), base_colors(scene))
    return from_mask(f"scribbles:{text}", torch.from_numpy(scribbles.select(inside, outside)))


def _mask_folder(kind: str, text: str, request: RegionRequest) -> tuple[Path, Path]:
    """Return the folder of masks, and the file of their cameras."""
    if not text:
        raise ProgdfError(f"{kind}: needs a folder; write {kind}:DIR with a mask for each camera in DIR")
    folder = Path(text).expanduser()
    if not folder.is_dir():
        raise ProgdfError(f"{folder} is not a folder; give the folder with the masks of the views")
    beside = folder / "cameras.json"
    if beside.is_file():
        return folder, beside
    if request.views.cameras is None:
        raise ProgdfError(
            f"the masks in {folder} have no cameras; give --cameras, or put a cameras.json beside them"
        )
    return folder, request.views.cameras


def _prompt(text: str) -> str:
    prompt = text.strip().strip("\"'“”").strip()
    if not prompt:
        raise ProgdfError('text: needs a prompt; write text:"the man\'s shirt"')
    return prompt


def _lift(
    scene: Gaussians,
    cameras: Sequence[Camera],
    masks: Sequence[Tensor | None],
    name: str,
    request: RegionRequest,
) -> Region:
    """Return the region that the masks select. A view without a mask adds nothing."""
    available = [
        (fit_size(c, LIFTED_AT), mask) for c, mask in zip(cameras, masks, strict=True) if mask is not None
    ]
    lift_cameras = with_near_plane([camera for camera, _ in available], scene)
    scaled = [_scale_mask(mask, camera) for camera, mask in available]
    region = lift_masks(
        scene,
        lift_cameras,
        scaled,
        name,
        request.options.lift_rule,
        request.options.lift_threshold,
        request.say,
    )
    if not len(region):
        raise ProgdfError(
            f"{name} selects no Gaussian by the rule {request.options.lift_rule}; its highest score is "
            f"{float(region.score.max()):.2g}; lower --lift-threshold"
        )
    return region


def _scale_mask(mask: Tensor, camera: Camera) -> Tensor:
    """Return the mask at the camera's size, averaged. [H,W] -> [h,w]"""
    size = (camera.height, camera.width)
    return mask.float() if tuple(mask.shape) == size else shrink_image(mask.float()[..., None], size)[..., 0]


def _masks_with_pixels(masks: Sequence[Tensor], prompt: str, request: RegionRequest) -> list[Tensor | None]:
    """Return the masks in which the prompt was found, and None for the others, as the object may still be
    there."""
    nonempty = [mask if bool(mask.any()) else None for mask in masks]
    if all(mask is None for mask in nonempty):
        raise ProgdfError(
            f"'{prompt}' is found in none of {len(masks)} views; rephrase it, or lower "
            f"--box-threshold (now {request.options.box_threshold:g})"
        )
    return nonempty


def _segment(
    scene: Gaussians, cameras: Sequence[Camera], prompt: str, folder: Path, request: RegionRequest
) -> list[Tensor]:
    """Return the prompt's mask in every view, from the cache if made from the same picture by the same
    networks."""
    options = request.options
    recipe: Recipe = {
        "prompt": prompt,
        "detector": options.detector,
        "sam_model": options.sam_model,
        "box_threshold": options.box_threshold,
    }
    networks = replace(options, region="")
    loaded: Callable[[], Segmenter] = cache(
        lambda: last_model("segmenter", networks, lambda: SEGMENTERS["text"](networks))
    )

    def paint(image: Tensor) -> Tensor:
        return loaded()(image, prompt).float()[..., None].expand(-1, -1, 3)

    pictures = PictureCache(folder)
    masks = []
    views = with_near_plane(cameras, scene)
    for camera in track(views, description=f"segment '{prompt}'", disable=request.quiet, transient=True):
        picture = render_view(scene, camera, torch.tensor(BACKGROUND)).clamp(0.0, 1.0)
        masks.append(pictures.picture(camera.name, picture, recipe, paint)[..., 0])
    return masks


def _segmented_cameras(scene: Gaussians, request: RegionRequest) -> list[Camera]:
    """Return the given cameras, evenly thinned out, or a rig around the scene."""
    if request.views.cameras is not None:
        offered = _cameras(request.views.cameras, scene, request)
        count = min(request.count, len(offered))
        selected = [offered[(2 * i + 1) * len(offered) // (2 * count)] for i in range(count)]
        return [replace(fit_size(camera, LIFTED_AT), lens=None) for camera in selected]
    up = request.up_of(scene)
    if is_surrounding(scene, up):
        return region_rig(scene, whole_scene(scene), request.count, LIFTED_AT, up)
    return name_cameras(orbit_rig(scene, request.count, LIFTED_AT, LIFTED_AT, up=up))


def _near_cameras(scene: Gaussians, region: Region, request: RegionRequest) -> list[Camera]:
    """Return a rig that looks at the found region."""
    rig = region_rig(scene, region, request.count, LIFTED_AT, request.up_of(scene))
    return [replace(camera, name=f"near_{i:03d}") for i, camera in enumerate(rig)]


def _cameras(path: Path, scene: Gaussians, request: RegionRequest) -> list[Camera]:
    """Return the cameras of a file in the scene's frame, named as views."""
    found = load_given_cameras(replace(request.views, cameras=path), scene)
    return name_cameras(found.cameras)


def _slug(prompt: str) -> str:
    return re.sub(r"[^\w]+", "-", prompt.lower()).strip("-")[:60] or "text"
