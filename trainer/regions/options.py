"""The options of `progdf region` and `progdf views`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from progdf.scene.up_axis import UpChoice


@dataclass(frozen=True)
class RegionOptions:
    """Show what a region selects in a scene, or keep it as a file for --region file:MEMBERS.npy."""

    scene: tyro.conf.Positional[Path]
    """The scene, a 3DGS .ply file."""
    spec: tyro.conf.Positional[str]
    """The region, as progdf train --region has it: box:…, lasso:…, masks:DIR, file:MEMBERS.npy, …"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """picture.png, in which the region is tinted and the rest is pale; or members.npy, its rows (int64)."""
    cameras: Path | None = None
    """masks: their cameras, where DIR holds none; text: views in which to look for it."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="FILE[:INDEX]")] = None
    """Look through a camera of this file, the first where no INDEX is given."""
    orbit: Annotated[str | None, tyro.conf.arg(metavar="AZ,EL[,DISTANCE]")] = None
    """Look from degrees around the scene, degrees above it, world units away (fitting); without camera and
    orbit the picture shows four sides."""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "640x480"
    """Pixels of the picture, or of each side; a camera's own if it is one."""
    up: UpChoice = "auto"
    """The axis of the scene that is up."""
    lift_rule: Literal["share", "count", "paper"] = "share"
    """masks, text: as for progdf train."""
    lift_threshold: float | None = None
    """masks, text: as for progdf train."""


@dataclass(frozen=True)
class ViewsOptions:
    """Write views of a scene and their cameras.json, to draw masks or edits on.

    Draw masks as OUT/NAME.png, white on black, for as many views as you like; then
    progdf train SCENE --cameras OUT/cameras.json --region masks:OUT
    """

    scene: tyro.conf.Positional[Path]
    """The scene, a 3DGS .ply file."""
    out: Path
    """Folder for original/NAME.png and cameras.json."""
    cameras: Path | None = None
    """cameras.json, transforms.json or the folder of a COLMAP model; without it, a rig around the scene."""
    region: str | None = None
    """The rig looks at this region instead of the whole scene."""
    views: int = 12
    """How many views, at most; of more cameras, those that differ most."""
    image_size: int = 768
    """Longer side of the views in pixels."""
    up: UpChoice = "auto"
    """The axis of the scene that is up."""
