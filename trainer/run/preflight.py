"""What can be known to go wrong with a training command before its scene is loaded and its folder made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from progdf.gaussians import ZERO
from progdf.io.atomic import read_file
from progdf.io.cameras import load_cameras
from progdf.scene.regions import check_region
from trainer.editors import check_editor, check_new_editor
from trainer.editors.pictures import picture_cameras
from trainer.options import TrainOptions
from trainer.regions.from_pictures import RegionRequest, region_checks
from trainer.store.run_folder import check_folder, open_run_folder

from .resume import load_region


def check_command(options: TrainOptions) -> None:
    """Look at everything that the command names, as far as it can be seen without the scene.

    A run that goes on needs no longer what it began with: its region and its edited views are kept.

    Args:
        options: resolved

    Raises:
        ProgdfError: the folder is taken, the editor or the segmenter cannot run, or a file is not there.
    """
    check_editor(options.editor.editor)
    folder, views = check_folder(options.out, options.edit), options.views
    if not options.scene.is_dir():  # some formats are folders
        read_file(options.scene, 0)
    if views.cameras is not None and not options.resume:
        load_cameras(views.cameras, ZERO)
    if views.pictures:
        cameras = [] if views.cameras is None else load_cameras(views.cameras, ZERO)
        picture_cameras(views.pictures, cameras, ZERO)
    if not options.resume or load_region(options.out) is None:
        check_region(options.region.region, region_checks(region_request(options, quiet=True)))
    if not folder.root.is_dir() or not any(folder.root.iterdir()):
        check_new_editor(replace(options.editor, cache=folder.painted))


def region_request(
    options: TrainOptions, quiet: bool, say: Callable[[str], None] | None = None
) -> RegionRequest:
    """How the region is made of pictures; those that are segmented are kept in the run's folder.

    Args:
        options: resolved
        quiet, say: see `RegionRequest`
    """

    def cache() -> Path:
        # nothing is written into a folder that is no run of ours
        return open_run_folder(options.out, options.edit).segmented

    return RegionRequest(options.region, options.views, cache, quiet, say)
