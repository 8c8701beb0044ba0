"""`progdf region` writes a region as a picture or a file of rows; `progdf views` writes views to draw masks
on."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians
from progdf.io.atomic import make_folder, write_files_together
from progdf.io.cameras import read_camera, save_cameras
from progdf.io.images import write_image
from progdf.io.tensors import save_npy
from progdf.region import Region, whole_scene
from progdf.scene.bounds import is_surrounding
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.regions import parse_region
from progdf.scene.subject import fit_camera
from progdf.scene.up_axis import find_up
from progdf.terminal import format_count, group_digits
from trainer.options import (
    RegionOptions,
    ShowRegionOptions,
    TrainingViewOptions,
    WriteViewsOptions,
    check_ranges,
)
from trainer.views.choose import choose_views, load_given_cameras
from trainer.views.view import (
    BACKGROUND,
    fit_size,
    name_cameras,
    region_rig,
    render_colors,
    render_view,
    seen_colors,
    with_near_plane,
)

from .from_pictures import RegionRequest, region_kinds

_TINT = torch.tensor([1.0, 0.32, 0.05])  # rgb of the region
_TINT_SHARE = 0.55
"""Share of the tint in the region's color, which leaves less than half of its own."""
_WHITE_SHARE = 0.72
"""Share of white in the gray of the remaining scene."""

_FOV = math.radians(45.0)
_FRAME_FILL = 0.9  # share of the picture that the scene fills
_SIDES = ((20.0, 15.0), (110.0, 15.0), (200.0, 15.0), (290.0, 15.0))  # azimuth and elevation, degrees


def show(options: ShowRegionOptions) -> list[str]:
    """Write the requested output; return log lines, the last with the region's number of Gaussians.

    Raises:
        ProgdfError: invalid scene, region or camera, or an output that is neither .png nor .npy.
    """
    suffix = options.out.suffix.lower()
    if suffix not in (".png", ".npy"):
        raise ProgdfError(
            f"{options.out} is not a .png or .npy file; use .png to show the region, .npy to keep it"
        )
    check_ranges(("--lift-threshold", options.lift_threshold, 0, 1))
    size = _size(options.size)
    scene = load_scene(options.scene)
    lines: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        masks = RegionOptions(options.spec, options.lift_rule, options.lift_threshold)
        views = TrainingViewOptions(options.cameras, options.cameras_anyway, options.up, scene=options.scene)
        request = RegionRequest(masks, views, lambda: Path(folder), say=lines.append)
        region = parse_region(options.spec, scene, kinds=region_kinds(request), say=lines.append)
    if suffix == ".npy":
        save_npy(options.out, region.members.numpy())
    else:
        found = load_given_cameras(views, scene)
        lines += found.notes
        up = find_up(scene, found.cameras, options.up, options.scene).direction
        cameras = with_near_plane(_cameras(options, scene, up, size), scene)
        write_image(options.out, _sheet([picture(scene, region, camera) for camera in cameras]))
    share = 100 * len(region) / max(1, len(scene))
    lines.append(
        f"wrote {options.out}: {format_count(len(region))} of {group_digits(len(scene))} ({share:.3g} %)"
    )
    return lines


def picture(scene: Gaussians, region: Region, camera: Camera) -> Tensor:
    """Return the scene in pale gray with the region tinted, with the usual occlusion. [H,W,3], 0 to 1"""
    colors = seen_colors(scene, camera)
    gray = (colors @ torch.tensor([0.299, 0.587, 0.114]))[:, None].clamp(0.0, 1.0)
    image = (gray + _WHITE_SHARE * (1 - gray)).expand(-1, 3).clone()
    rows = region.members
    # the tint follows the original brightness, so that shape and shading stay readable
    image[rows] = torch.lerp(colors[rows].clamp(0.0, 1.0), _TINT * (0.35 + 0.65 * gray[rows]), _TINT_SHARE)
    return render_colors(scene, image, camera, torch.ones(3)).clamp(0.0, 1.0)


def _cameras(options: ShowRegionOptions, scene: Gaussians, up: Tensor, size: tuple[int, int]) -> list[Camera]:
    if options.camera is not None:
        return [replace(read_camera(options.camera, scene.origin), lens=None)]
    return [fit_camera(scene, up, turn, size, _FOV, _FRAME_FILL) for turn in _SIDES]


def _sheet(pictures: Sequence[Tensor]) -> Tensor:
    """Return a single picture unchanged, and four in two rows. [H,W,3]"""
    if len(pictures) == 1:
        return pictures[0]
    half = len(pictures) // 2
    return torch.cat([torch.cat(list(pictures[:half]), dim=1), torch.cat(list(pictures[half:]), dim=1)])


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()) or not all(
        1 <= int(side) <= 8192 for side in (width, height)
    ):
        raise ProgdfError(
            f"--size {text} is not a size; write WIDTHxHEIGHT of up to 8192, for example 640x480"
        )
    return int(width), int(height)


def write(options: WriteViewsOptions) -> list[str]:
    """Write OUT/original/NAME.png and OUT/cameras.json; return log lines with the files and the next step.

    Raises:
        ProgdfError: invalid scene, cameras or region, or a folder that already has cameras.
    """
    check_ranges(("--views", options.views, 1, 96), ("--image-size", options.image_size, 32, 4096))
    out = options.out
    background = torch.tensor(BACKGROUND)
    if (out / "cameras.json").exists() or (out.exists() and not out.is_dir()):
        raise ProgdfError(f"{out / 'cameras.json'} already exists; give --out another folder")
    scene = load_scene(options.scene)
    views = TrainingViewOptions(
        options.cameras, options.cameras_anyway, options.up, options.views, scene=options.scene
    )
    found = load_given_cameras(views, scene)
    given = found.cameras
    up = find_up(scene, given, options.up, options.scene).direction
    region = None
    if options.region is not None:
        request = RegionRequest(RegionOptions(options.region), views, lambda: out / "segmented")
        region = parse_region(options.region, scene, kinds=region_kinds(request))
    if given:
        # renders and the masks over them have no distortion, so drop the lens
        cameras = [replace(fit_size(camera, options.image_size), lens=None) for camera in given]
    elif region is not None or is_surrounding(scene, up):
        cameras = region_rig(scene, region or whole_scene(scene), options.views, options.image_size, up)
    else:
        cameras = orbit_rig(scene, options.views, options.image_size, options.image_size, up=up)
    cameras = with_near_plane(name_cameras(cameras), scene)
    if len(cameras) > options.views:
        choice = choose_views(scene, region or whole_scene(scene), cameras, options.views, background)
        cameras = [view.camera for view in choice.views]
    make_folder(out.absolute().parent)
    with write_files_together(out) as folder:
        for camera in cameras:
            picture = render_view(scene, camera, background)
            write_image(folder / "original" / f"{camera.name}.png", picture)
        save_cameras(folder / "cameras.json", cameras, scene.origin)
    next_step = (
        f"wrote {len(cameras)} views to {out / 'original'}; draw masks (white on black) as "
        f"{out}/NAME.png for some of them, then progdf train {options.scene} "
        f"--cameras {out / 'cameras.json'} --region masks:{out} …"
    )
    return [*found.notes, next_step]
