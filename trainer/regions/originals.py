"""`progdf views`: the originals that a person draws masks or edits on, and the cameras they belong to."""

from __future__ import annotations

from dataclasses import replace

import torch

from progdf.errors import ProgdfError
from progdf.formats.scene_file import load_scene
from progdf.io.cameras import load_cameras, save_cameras
from progdf.io.images import write_image
from progdf.region import whole_scene
from progdf.scene.bounds import is_surrounding
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.region_spec import parse_region
from progdf.scene.up_axis import find_up
from trainer.options import RegionOptions, ViewOptions, WriteViewsOptions, check_ranges
from trainer.views.choose import choose_views
from trainer.views.view import (
    BACKGROUND,
    INSIDE,
    fit_size,
    name_cameras,
    region_rig,
    render_view,
    with_near_plane,
)

from .from_pictures import RegionRequest, region_kinds


def write(options: WriteViewsOptions) -> str:
    """Write OUT/original/NAME.png and OUT/cameras.json; what to do with them, in a line.

    Raises:
        ProgdfError: scene, cameras or region that do not work, or a folder that has such cameras already.
    """
    check_ranges(("--views", options.views, 1, 96), ("--image-size", options.image_size, 32, 4096))
    out, background = options.out, torch.tensor(BACKGROUND)
    if (out / "cameras.json").exists() or (out.exists() and not out.is_dir()):
        raise ProgdfError(f"{out / 'cameras.json'} already exists; give --out another folder")
    scene = load_scene(options.scene)
    given = [] if options.cameras is None else load_cameras(options.cameras, scene.origin)
    up = find_up(scene, given, options.up, options.scene).direction
    region = None
    if options.region is not None:
        views = ViewOptions(options.cameras, options.up, options.views, scene=options.scene)
        request = RegionRequest(RegionOptions(options.region), views, lambda: out / "segmented")
        region = parse_region(options.region, scene, kinds=region_kinds(request))
    if given:
        # what is drawn is straight, and so are the masks: no lens
        cameras = [replace(fit_size(camera, options.image_size), lens=None) for camera in given]
    elif is_surrounding(scene, up):
        raise ProgdfError(f"{options.scene} {INSIDE}")
    elif region is not None:
        cameras = region_rig(scene, region, options.views, options.image_size, up)
    else:
        cameras = orbit_rig(scene, options.views, options.image_size, options.image_size, up=up)
    cameras = with_near_plane(name_cameras(cameras), scene)
    if len(cameras) > options.views:
        choice = choose_views(scene, region or whole_scene(scene), cameras, options.views, background)
        cameras = [view.camera for view in choice.views]
    for camera in cameras:
        write_image(out / "original" / f"{camera.name}.png", render_view(scene, camera, background))
    save_cameras(out / "cameras.json", cameras, scene.origin)
    return (
        f"wrote {len(cameras)} views to {out / 'original'}; draw masks (white on black) as "
        f"{out}/NAME.png for some of them, then progdf train {options.scene} "
        f"--cameras {out / 'cameras.json'} --region masks:{out} …"
    )
