"""What can be known to go wrong with a training command before its scene is loaded and its folder made."""

from __future__ import annotations

from collections.abc import Mapping

from progdf.io.atomic import check_regular, open_error
from progdf.io.cameras import load_cameras
from progdf.scene.region_spec import check_region
from trainer.editors import check_editor, check_new_editor
from trainer.options import TrainOptions
from trainer.regions.from_pictures import region_checks, region_settings
from trainer.setup.training_setup import editor_settings
from trainer.store.run_folder import check_folder

from .resume import load_region


def check_command(options: TrainOptions, edit: Mapping[str, str]) -> None:
    """Look at everything that the command names, as far as it can be seen without the scene.

    A run that goes on needs no longer what it began with: its region and its edited views are kept.

    Args:
        options: resolved
        edit: see `check_folder`

    Raises:
        ProgdfError: --out is taken, the editor or the segmenter cannot run, or a file is not there.
    """
    check_editor(options.editor)
    folder = check_folder(options.out, edit)
    if not options.scene.is_dir():  # some formats are folders
        check_regular(options.scene)
        try:
            options.scene.open("rb").close()
        except OSError as error:
            raise open_error(options.scene, error) from None
    if options.cameras is not None and not options.resume:
        load_cameras(options.cameras)
    if load_region(options) is None:
        check_region(options.region, region_checks(region_settings(options, edit, quiet=True)))
    if not folder.root.is_dir() or not any(folder.root.iterdir()):
        check_new_editor(options.editor, editor_settings(options, folder))
