"""Options of `progdf render` and `progdf export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes

from progdf.formats.axes import GlbAxes
from progdf.scene import UpChoice
from viewer.files.web_page import PageOptions

from .stack_options import DrawingOptions, StackOptions, Switch, word


@dataclass(frozen=True, kw_only=True)
class ViewpointOptions:
    """Camera and size of a picture."""

    camera: Annotated[str | None, word("FILE[:INDEX]", "the session's, else chosen from the scene")] = None
    """Camera of cameras.json or transforms.json; without INDEX the first."""
    orbit: Annotated[str | None, word("AZ,EL[,DISTANCE]", "the session's, else chosen from the scene")] = None
    """Orbit camera: azimuth and elevation in degrees, distance in world units (fits the scene)."""
    frame: Annotated[str | None, word("NAME|all", "the subject of the scene")] = None
    """Fill the picture with an edit's region or the whole scene."""
    size: Annotated[str | None, word("WIDTHxHEIGHT", "the camera's own, or 640x480")] = None
    """Width and height in pixels."""


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """Write a picture of a scene with its edits, without a window."""

    stack: OmitArgPrefixes[StackOptions]
    out: Annotated[Path, word("FILE", aliases=["-o"])]
    """Output: .png; animations .gif, .webp or .mp4; a film also as a folder of frames."""
    viewpoint: OmitArgPrefixes[ViewpointOptions] = ViewpointOptions()
    drawing: OmitArgPrefixes[DrawingOptions] = DrawingOptions()
    alpha: Switch = False
    """Make the background transparent; write a picture as .png, a film as .webp or a folder."""
    sweep: Annotated[str | None, word("NAME|all", "a still picture")] = None
    """Animate this edit's slider from 0 to 1 and back, or all sliders in turn."""
    turntable: Annotated[str | None, word("SECONDS", "a still picture")] = None
    """Film of one orbit around the scene at the given strengths."""
    sheet: Annotated[str | None, word("NAME[,NAME2]", "one picture")] = None
    """Contact sheet over this edit's slider, or a grid over two sliders."""
    split: Annotated[str | None, word("[X]", "the session's comparison, else none")] = None
    """Split with the original; the edited side begins at this share of the width (0.5)."""
    difference: Annotated[str | None, word("[AMPLIFY]", "the session's comparison, else none")] = None
    """Show the difference to the original, amplified (4), and its PSNR."""
    timeline: Switch = False
    """Film of the session's timeline: .gif, .webp, .mp4, or a folder of .png frames."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Write a scene with its edits for other programs or as a web page, or a grade as a .cube file."""

    stack: OmitArgPrefixes[StackOptions]
    out: Annotated[Path, word("FILE", aliases=["-o"])]
    """Output: a 3DGS scene, a .html page, a .progdf.zip or a .cube; formats: see docs/formats.md."""
    frames: Annotated[int | None, word("N", "one file")] = None
    """Number of files (.usdc: time samples) from the original to the strengths, or over the --timeline."""
    timeline: Switch = False
    """Write one scene per frame of the session's timeline, without its camera."""
    glb_axes: GlbAxes = "LUF"
    """Axes of a .glb: LUF (glTF, splat-transform) or RUB (OpenGL, .spz, .usdc)."""
    page: OmitArgPrefixes[PageOptions] = PageOptions()
    up: UpChoice = "auto"
    """Up axis of the page; auto: as used to train the edits, else estimated from the ground."""
    background: Annotated[str, word("COLOR")] = "white"
    """Background of the page: #rrggbb, white or black."""

    @property
    def drawing(self) -> DrawingOptions:
        """Drawing options of a page."""
        return DrawingOptions(up=self.up, background=self.background)
