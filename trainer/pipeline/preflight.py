"""What can be known to go wrong with a training command before its scene is loaded and its folder made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from progdf.gaussians import ZERO
from progdf.io.atomic import read_file
from progdf.io.cameras import load_cameras
from progdf.scene.regions import check_region
from trainer.editors import check_editor, check_new_editor
from trainer.editors.pictures import picture_cameras
from trainer.options import VIEWS
from trainer.plan import Plan
from trainer.regions.from_pictures import RegionSettings, region_checks
from trainer.store.run_folder import check_folder, open_run_folder

from .resume import load_region


def check_command(plan: Plan, out: Path, resume: bool) -> None:
    """Look at everything that the command names, as far as it can be seen without the scene.

    A run that goes on needs no longer what it began with: its region and its edited views are kept.

    Args:
        plan: see `Plan`
        out: folder of the run
        resume: go on with a run that was stopped in it

    Raises:
        ProgdfError: the folder is taken, the editor or the segmenter cannot run, or a file is not there.
    """
    check_editor(plan.editor.editor)
    folder = check_folder(out, plan.edit)
    if not plan.scene.is_dir():  # some formats are folders
        read_file(plan.scene, 0)
    if plan.views.cameras is not None and not resume:
        load_cameras(plan.views.cameras, ZERO)
    if plan.views.pictures:
        given = [] if plan.views.cameras is None else load_cameras(plan.views.cameras, ZERO)
        picture_cameras(plan.views.pictures, given, ZERO)
    if not resume or load_region(out) is None:
        check_region(plan.region.region, region_checks(region_settings(plan, out, quiet=True)))
    if not folder.root.is_dir() or not any(folder.root.iterdir()):
        check_new_editor(plan.editor.editor, plan.editor.settings(folder.painted))


def region_settings(
    plan: Plan, out: Path, quiet: bool, say: Callable[[str], None] | None = None
) -> RegionSettings:
    """How the region is made of pictures; those that are segmented are kept in the run's folder.

    Args:
        plan: see `Plan`
        out: folder of the run
        quiet, say: see `RegionSettings`
    """

    def kept() -> Path:
        # nothing is written into a folder that is no run of ours
        return open_run_folder(out, plan.edit).segmented

    region = plan.region
    return RegionSettings(
        plan.views.cameras,
        plan.views.views or VIEWS,
        kept,
        region.lift_rule,
        region.lift_threshold,
        region.segmenter,
        quiet,
        plan.views.up,
        plan.scene,
        say,
        plan.views.pictures,
    )
