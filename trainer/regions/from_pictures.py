"""Regions that pictures tell of: masks:DIR, photomasks:DIR and text:"…", lifted from 2D to Gaussians."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from rich.progress import track
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, Origin
from progdf.io.cameras import load_cameras, save_cameras
from progdf.io.picture_camera import edits_in_picture
from progdf.region import Region
from progdf.scene.bounds import is_surrounding
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.regions import Check, Kind
from progdf.scene.up_axis import UpChoice, find_up
from trainer.editors.cache import KeptPictures, Recipe
from trainer.editors.pictures import picture_paths, rendered_cameras
from trainer.options import LiftRule
from trainer.segmenters import SEGMENTER_CHECKS, SEGMENTERS, Segmenter, SegmenterSettings
from trainer.segmenters.folder import read_masks
from trainer.views.view import (
    BACKGROUND,
    INSIDE,
    fit_size,
    name_cameras,
    region_rig,
    render_view,
    with_near_plane,
)

from .changed import LIFTED_AT, changed_region
from .lift import lift_masks


@dataclass(frozen=True)
class RegionSettings:
    """How masks become a region.

    Args:
        cameras: file of cameras, as --cameras; None: a rig around the scene, for masks that are made here
        views: how many pictures are segmented, at most; without cameras, as many again from nearer
        rule: see `lift.score`
        threshold: least score of a member, 0..1; None is the rule's own
        segmenter: which networks, how sure
        kept: makes, and names, the folder in which segmented pictures are kept
        quiet: no progress on the screen
        up: as --up
        scene: the scene's file, whose format may say which way is up
        say: hears in a line each what became of the masks
        pictures: changed pictures, for the kind `changed`
    """

    cameras: Path | None
    views: int
    kept: Callable[[], Path]
    rule: LiftRule = "share"
    threshold: float | None = None
    segmenter: SegmenterSettings = SegmenterSettings()
    quiet: bool = False
    up: UpChoice = "auto"
    scene: Path | None = None
    say: Callable[[str], None] | None = None
    pictures: Sequence[Path] = ()

    def up_of(self, scene: Gaussians) -> Tensor:
        """The direction that is up in a scene without cameras. [3]"""
        return find_up(scene, (), self.up, self.scene).direction


def region_kinds(settings: RegionSettings) -> dict[str, Kind]:
    """The kinds of region that pictures tell of, for `parse_region`.

    masks:DIR are drawn over straight pictures, as RUN/views/original are; photomasks:DIR over photographs,
    which are straightened where the cameras have lenses; `changed` is where pictures differ from the scene.
    """

    def from_folder(rest: str, scene: Gaussians, bent: bool) -> Region:
        kind = "photomasks" if bent else "masks"
        folder, file = _mask_folder(kind, rest, settings)
        cameras = _cameras(file, scene)
        masks = read_masks(folder, cameras, bent)
        count = sum(mask is not None for mask in masks)
        if settings.say is not None and count < len(masks):
            settings.say(f"{count} of {len(masks)} cameras have a mask; the others tell nothing")
        return _lift(scene, cameras, masks, f"{kind}:{rest}", settings)

    def from_text(rest: str, scene: Gaussians) -> Region:
        prompt = _prompt(rest)
        folder = settings.kept() / _slug(prompt)
        cameras = _segmented_cameras(scene, settings)
        masks = _segment(scene, cameras, prompt, folder, settings)
        found = _masks_with_pixels(masks, prompt, settings)
        if settings.cameras is None:
            # Around the scene a thing may be a few pixels wide: look again from where it fills the picture;
            # with masks of the bear's body a pixel too wide or too narrow, IoU .93 for .61-.68.
            nearer = _near_cameras(scene, _lift(scene, cameras, found, prompt, settings), settings)
            masks = [*masks, *_segment(scene, nearer, prompt, folder, settings)]
            cameras, found = [*cameras, *nearer], _masks_with_pixels(masks, prompt, settings)
        # with these the folder is one for masks:DIR, of the same region
        telling = [camera for camera, mask in zip(cameras, found, strict=True) if mask is not None]
        save_cameras(folder / "cameras.json", telling, scene.origin)
        return _lift(scene, cameras, found, f"text:{prompt}", settings)

    return {
        "masks": lambda rest, scene: from_folder(rest, scene, bent=False),
        "photomasks": lambda rest, scene: from_folder(rest, scene, bent=True),
        "text": from_text,
        "changed": lambda rest, scene: changed_region(
            scene, *_changed_pictures(rest, settings, scene.origin), settings.threshold, settings.say
        ),
    }


def region_checks(settings: RegionSettings) -> dict[str, Check]:
    """What is to be known of these kinds before the scene is loaded, for `check_region`."""

    def of_text(rest: str) -> None:
        _prompt(rest)
        SEGMENTER_CHECKS["text"](settings.segmenter)

    return {
        "masks": lambda rest: load_cameras(_mask_folder("masks", rest, settings)[1], ZERO),
        "photomasks": lambda rest: load_cameras(_mask_folder("photomasks", rest, settings)[1], ZERO),
        "text": of_text,
        "changed": lambda rest: _changed_pictures(rest, settings, ZERO),
    }


def _changed_pictures(
    rest: str, settings: RegionSettings, origin: Origin
) -> tuple[Sequence[Path], Sequence[Camera]]:
    """The pictures of `changed:A.png,B.png`, by default those of the editor, and their cameras."""
    paths = picture_paths(rest) if rest else settings.pictures
    if not paths:
        raise ProgdfError(
            "changed needs pictures: use it with --editor pictures:A.png, or name them, changed:A.png,B.png"
        )
    for path in paths:
        if edits := edits_in_picture(path):
            raise ProgdfError(
                f"{path} was taken with edits on ({edits}), which would count as changed; take the view "
                "without them, or name the region with --region"
            )
    given = [] if settings.cameras is None else load_cameras(settings.cameras, origin)
    return paths, rendered_cameras(paths, given, origin)


def _mask_folder(kind: str, rest: str, settings: RegionSettings) -> tuple[Path, Path]:
    """The folder of masks, and the file of their cameras."""
    if not rest:
        raise ProgdfError(f"{kind}: needs a folder; write {kind}:DIR with a mask for each camera in DIR")
    folder = Path(rest).expanduser()
    if not folder.is_dir():
        raise ProgdfError(f"{folder} is not a folder; give the one that holds a mask for each view")
    own = folder / "cameras.json"
    if own.is_file():
        return folder, own
    if settings.cameras is None:
        raise ProgdfError(
            f"the masks in {folder} have no cameras; give --cameras, or put a cameras.json beside them"
        )
    return folder, settings.cameras


def _prompt(rest: str) -> str:
    prompt = rest.strip().strip("\"'“”").strip()
    if not prompt:
        raise ProgdfError('text: needs a prompt; write text:"the man\'s shirt"')
    return prompt


def _lift(
    scene: Gaussians,
    cameras: Sequence[Camera],
    masks: Sequence[Tensor | None],
    name: str,
    settings: RegionSettings,
) -> Region:
    """The region that the masks select; a view without a mask adds nothing."""
    given = [
        (fit_size(c, LIFTED_AT), mask) for c, mask in zip(cameras, masks, strict=True) if mask is not None
    ]
    small = with_near_plane([camera for camera, _ in given], scene)
    scaled = [_scale_mask(mask, camera) for camera, mask in given]
    region = lift_masks(scene, small, scaled, name, settings.rule, settings.threshold, settings.say)
    if not len(region):
        way = "lower --lift-threshold"
        if settings.rule == "paper":
            way = "far below the printed .8: give --lift-rule share, or lower --lift-threshold"
        raise ProgdfError(
            f"{name} selects no Gaussian by the rule {settings.rule}; its highest score is "
            f"{float(region.score.max()):.2g}, {way}"
        )
    return region


def _scale_mask(mask: Tensor, camera: Camera) -> Tensor:
    """The mask in the camera's size, averaged. [H,W] -> [h,w]"""
    size = (camera.height, camera.width)
    if tuple(mask.shape) == size:
        return mask.float()
    return torch.nn.functional.interpolate(mask.float()[None, None], size=size, mode="area")[0, 0]


def _masks_with_pixels(masks: Sequence[Tensor], prompt: str, settings: RegionSettings) -> list[Tensor | None]:
    """The masks in which the prompt was found: where it was not, it may still be."""
    found = [mask if bool(mask.any()) else None for mask in masks]
    if all(mask is None for mask in found):
        raise ProgdfError(
            f"'{prompt}' is found in none of {len(masks)} views; rephrase it, or lower "
            f"--box-threshold (now {settings.segmenter.box_threshold:g})"
        )
    return found


def _segment(
    scene: Gaussians, cameras: Sequence[Camera], prompt: str, folder: Path, settings: RegionSettings
) -> list[Tensor]:
    """The prompt's mask in every view; read where it is kept, of the same picture by the same networks."""
    chosen = settings.segmenter
    recipe: Recipe = {
        "prompt": prompt,
        "detector": chosen.detector,
        "sam_model": chosen.sam_model,
        "box_threshold": chosen.box_threshold,
    }
    loaded: Callable[[], Segmenter] = cache(lambda: SEGMENTERS["text"](chosen))

    def paint(image: Tensor) -> Tensor:
        return loaded()(image, prompt).float()[..., None].expand(-1, -1, 3)

    kept = KeptPictures(folder)
    masks = []
    views = with_near_plane(cameras, scene)
    for camera in track(views, description=f"segment '{prompt}'", disable=settings.quiet, transient=True):
        picture = render_view(scene, camera, torch.tensor(BACKGROUND)).clamp(0.0, 1.0)
        masks.append(kept.picture(camera.name, picture, recipe, paint)[..., 0])
    return masks


def _segmented_cameras(scene: Gaussians, settings: RegionSettings) -> list[Camera]:
    """The given cameras, evenly thinned out, or a rig around the scene."""
    if settings.cameras is not None:
        offered = _cameras(settings.cameras, scene)
        count = min(settings.views, len(offered))
        taken = [offered[(2 * i + 1) * len(offered) // (2 * count)] for i in range(count)]
        return [replace(fit_size(camera, LIFTED_AT), lens=None) for camera in taken]
    up = settings.up_of(scene)
    if is_surrounding(scene, up):
        raise ProgdfError(f"the scene {INSIDE}")
    return name_cameras(orbit_rig(scene, settings.views, LIFTED_AT, LIFTED_AT, up=up))


def _near_cameras(scene: Gaussians, region: Region, settings: RegionSettings) -> list[Camera]:
    """A rig that looks at what was found."""
    rig = region_rig(scene, region, settings.views, LIFTED_AT, settings.up_of(scene))
    return [replace(camera, name=f"near_{i:03d}") for i, camera in enumerate(rig)]


def _cameras(path: Path, scene: Gaussians) -> list[Camera]:
    return name_cameras(load_cameras(path, scene.origin))


def _slug(prompt: str) -> str:
    return re.sub(r"[^\w]+", "-", prompt.lower()).strip("-")[:60] or "text"
