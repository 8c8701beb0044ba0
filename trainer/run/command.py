"""Check of a training command, and selection of its region."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians
from progdf.io.atomic import read_file
from progdf.io.cameras import load_cameras
from progdf.io.json_values import check_text
from progdf.io.picture_camera import camera_file, layers_in_picture, stored_picture_camera
from progdf.rasterize.engines import get_engine
from progdf.region import Region
from progdf.scene.regions import check_region, parse_region
from progdf.scene.taken_views import find_taken_view
from trainer.editors import check_editor, check_new_editor, check_server, editor_row
from trainer.options import TrainOptions, flat_values
from trainer.regions.from_pictures import RegionRequest, region_checks, region_kinds
from trainer.resolve import recorded_options
from trainer.store.pretrained import LastValueCache
from trainer.store.run_folder import (
    check_folder,
    open_run_folder,
)
from trainer.views.lower_layers import check_lower_layers
from trainer.views.picture_cameras import picture_cameras
from trainer.views.setup import check_given_cameras

from .resume import load_region

_log = logging.getLogger(__name__)


def check_command(options: TrainOptions) -> None:
    """Check everything that the command names, as far as possible without the scene.

    A resumed run no longer needs its sources, as its region and its edited views are saved.

    Args:
        options: resolved options

    Raises:
        ProgdfError: the folder is occupied, the editor or the segmenter cannot run, its server cannot be
            reached, a file is missing, or a text for the run's record is not UTF-8.
    """
    for name, _, value in flat_values(recorded_options(options)):
        for part in value if isinstance(value, tuple) else (value,):
            check_text(str(part), f"the record of --{name.replace('_', '-')}")
    get_engine(options.optimize.engine)
    check_editor(options.editor.editor)
    folder = check_folder(options.out, options.edit)
    views = options.views
    if not options.scene.is_dir():  # some formats are folders
        read_file(options.scene, 0)
    if views.cameras is not None and not options.resume:
        load_cameras(views.cameras, ZERO)
    if views.pictures:
        cameras = [] if views.cameras is None else load_cameras(views.cameras, ZERO)
        _find_cameras(views.pictures, cameras, options.scene)
        picture_cameras(views.pictures, cameras, ZERO)
    elif editor_row(options.editor).run == "removed":
        for path in editor_row(options.editor).files(options.editor.text):
            if (shown := layers_in_picture(path)) is not None:
                raise ProgdfError(f"{path} shows edits ({shown}); take the view without them")
    check_lower_layers(shown_pictures(options), options.scene)
    if not options.resume or load_region(options.out) is None:
        check_region(options.region.region, region_checks(region_request(options, quiet=True)))
    is_new = not folder.root.is_dir() or not any(folder.root.iterdir())
    if is_new or (editor_row(options.editor).slow_strengths and not options.resume):
        check_new_editor(replace(options.editor, cache=folder.paintings))
    if is_new:  # an earlier run of the folder may have kept all pictures
        check_server(options.editor)


def shown_pictures(options: TrainOptions) -> tuple[Path, ...]:
    """Return the editor's pictures of the scene, whose paint lies above the layers that they show.

    Args:
        options: resolved options
    """
    row = editor_row(options.editor)
    return row.files(options.editor.text) if row.shows_scene else ()


def _find_cameras(pictures: Sequence[Path], cameras: Sequence[Camera], scene: Path) -> None:
    """Find pictures without a camera among the views taken in the window; write their cameras beside them."""
    for path in pictures:
        if stored_picture_camera(path, cameras, ZERO) is None:
            found = find_taken_view(path, scene)
            if found is not None:
                line = "%s shows a view taken in the window (%s); wrote %s"
                _log.warning(line, path, found.agreement, camera_file(path))


def region_request(
    options: TrainOptions, quiet: bool, say: Callable[[str], None] | None = None
) -> RegionRequest:
    """Return the request for a region made from pictures. Segmentation masks are saved in the run's folder.

    Args:
        options: resolved options
        quiet, say: see `RegionRequest`
    """

    def cache() -> Path:
        # never write into a folder that is not a run folder
        return open_run_folder(options.out, options.edit).segment_masks

    return RegionRequest(options.region, options.views, cache, quiet, say)


def select_region(
    options: TrainOptions, scene: Gaussians, quiet: bool, shared: LastValueCache
) -> tuple[Region, list[str]]:
    """Return the region that resolved options name, and lines for the log.

    Raises:
        ProgdfError: see `parse_region`; or the cameras are invalid or probably in another frame.
    """

    def select() -> tuple[Region, list[str]]:
        notes = list[str]()
        check_given_cameras(options.views, scene)  # fail before a folder is created
        kinds = region_kinds(region_request(options, quiet, notes.append))
        return parse_region(options.region.region, scene, options.name, kinds, notes.append), notes

    return shared.get("region", (options.scene.resolve(), options.region, options.views), select)
