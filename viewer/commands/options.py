"""The options of `progdf view`, `render` and `export`; their command lines are made from these."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from progdf.scene.up_axis import UpChoice

Blend = Literal["normalized", "sum", "over"]
Settings = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=S"), tyro.conf.UseAppendAction]
Gains = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME:KIND=G"), tyro.conf.UseAppendAction]
Paint = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=FILE.npy"), tyro.conf.UseAppendAction]
Solo = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME"), tyro.conf.UseAppendAction]
Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
Edits = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="EDIT.gdf")]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]

NO_SCENE = Path()
"""What stands for the scene where none is given."""


@dataclass(frozen=True, kw_only=True)
class StackOptions:
    """A scene under a stack of edits: what the three commands have in common."""

    scene: Scene
    """The scene: a .ply, .spz, .splat, .ksplat or .sog; or a session (Ctrl+S), also as --session FILE."""
    gdfs: Edits = ()
    """Edits of this scene, the lowest layer first."""
    set: Settings = ()
    """Strength of an edit, 0 to 1; repeat it for several edits. An edit that is not named is at 1 in `render`
    and `export`, at 0 in `view`, --sweep and --sheet, and as a session has it."""
    gain: Gains = ()
    """How much of one kind of change an edit lets through, 0 to 1: geometry, opacity or color."""
    solo: Solo = ()
    """Show this edit alone. Repeat it for several edits."""
    paint: Paint = ()
    """Painted strength of an edit: a .npy of weights 0 to 1, one per member or per Gaussian."""
    overshoot: bool = False
    """Overshoot to 1.2: extrapolates past the trained range."""
    blend: Blend | None = None
    """How edits that share Gaussians add up; by default the session's rule, else normalized."""


@dataclass(frozen=True, kw_only=True)
class PictureOptions(StackOptions):
    """The stack as a picture shows it."""

    up: UpChoice = "auto"
    """The axis of the scene that is up; auto: as the edits were trained, else from the ground, else −y."""
    background: str = "white"
    """#rrggbb, white or black."""
    engine: Annotated[Literal["auto", "gl", "cpu"], tyro.conf.arg(aliases=["--draw"])] = "auto"
    """What draws: OpenGL or the CPU rasterizer; auto takes OpenGL where a graphics card does the work."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions(PictureOptions):
    """Open the window: the splats, one slider per edit. Without a scene it opens on a start page."""

    scene: Scene = NO_SCENE
    """The scene: a .ply, .spz, .splat, .ksplat or .sog; or a session (Ctrl+S), also as --session FILE."""


@dataclass(frozen=True, kw_only=True)
class RenderOptions(PictureOptions):
    """Write a picture of a scene under its edits, without a window."""

    out: Out
    """The picture to write: .png, with --sweep .gif or .mp4; with --timeline also a folder."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="FILE[:INDEX]")] = None
    """A camera of cameras.json or transforms.json, the first where no INDEX is given."""
    orbit: Annotated[str | None, tyro.conf.arg(metavar="AZ,EL[,DISTANCE]")] = None
    """A camera that circles the scene: degrees around it, degrees above it, world units away (fitting)."""
    frame: Annotated[str | None, tyro.conf.arg(metavar="NAME|all")] = None
    """What fills the picture: an edit's region, or the whole scene; else what stands in the scene."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Pixels; else the camera's own, or 640x480."""
    alpha: bool = False
    """A transparent background, in a .png."""
    sweep: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Move this edit's slider from 0 to 1 and back: an animation."""
    sheet: Annotated[str | None, tyro.conf.arg(metavar="NAME[,NAME2]|N")] = None
    """A contact sheet over this edit's slider, a grid over two sliders, or N pictures of the --timeline."""
    split: Annotated[str | None, tyro.conf.arg(metavar="[X]")] = None
    """The original beside the edited picture, which begins at this share of the width (0.5)."""
    difference: Annotated[str | None, tyro.conf.arg(metavar="[AMPLIFY]")] = None
    """What differs from the original, amplified (4), with the PSNR."""
    against: Literal["original", "recorded"] | None = None
    """What --split and --difference compare with: the original, or what training recorded."""
    timeline: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None
    """A film of the keys in this file (Ctrl+K in the window), or in the session: .gif, .mp4, or a folder for
    .png frames; with --sheet N a contact sheet of N of them."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions(StackOptions):
    """Write a scene under its edits as a 3DGS .ply file."""

    out: Out
    """The .ply file to write."""
