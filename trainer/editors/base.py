"""Interface of image editors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.region import Region
from trainer.options import EditKind, EditorOptions, Kind
from trainer.paint.discs import PaintedView
from trainer.views.view import RegionThumbnail, View

Waiting = Callable[[str], AbstractContextManager[object]]
"""Function that reports a wait, described by a line, while its context is open."""


@dataclass(frozen=True)
class EditorInput:
    """Arguments from which an editor is made."""

    what: str  # the text after the colon in `--editor`
    scene: Gaussians  # the original
    region: Region
    views: Sequence[View]
    options: EditorOptions
    # Small samples of the region, independent of the views. If there are none, the region's color is computed
    # from the views.
    glances: Callable[[], Sequence[RegionThumbnail]] = list
    seen: Gaussians | None = None  # the scene that edited pictures show; None: `scene`
    say: Callable[[str], object] = str  # receives lines for the run's log; the default drops them
    waiting: Waiting = nullcontext  # reports waits for a server; the default drops them


class ImageEditor(Protocol):
    """Editor of pictures of one region.

    An editor with a strength control edits at any strength. An editor without one edits only at strength 1.
    """

    @property
    def kind(self) -> EditKind:
        """Kind of change: color, style or geometry."""
        ...

    @property
    def stages(self) -> tuple[float, ...]:
        """Strengths at which the editor can edit, ascending, the last one 1. Empty: any strength."""
        ...

    @property
    def is_confined(self) -> bool:
        """True if the edit leaves pixels outside the region unchanged."""
        ...

    def edit(self, view: View, strength: float) -> Tensor:
        """Return the edited view. Strength 0 returns `view.image` bit for bit. -> [H,W,3] 0..1"""
        ...


def editor_strengths(editor: ImageEditor, stages: int) -> tuple[float, ...]:
    """Return the strengths to request: the editor's own, or `stages` evenly spaced ones."""
    return editor.stages or tuple((i + 1) / stages for i in range(stages))


def confines_edit(editor: ImageEditor, kind: Kind) -> bool:
    """Return True if the run must revert changes outside the region.

    That is the case if the editor can cause such changes and the edit moves no parts.
    """
    return kind != "geometry" and not editor.is_confined


class PastingEditor(ImageEditor, Protocol):
    """Editor that pastes paint onto the surface that views show. Its row has the run "pasted"."""

    @property
    def view(self) -> View:
        """View of the first paint, in which the edit is measured."""
        ...

    @property
    def paints(self) -> Sequence[PaintedView]:
        """Paint of each view, as the targets of the surface discs."""
        ...

    @property
    def left_out(self) -> int:
        """Pixels of the given pictures that show no surface of the region and stay unpainted."""
        ...

    @property
    def finds_colors(self) -> bool:
        """True if colors of the scene's Gaussians replace discs where they are at least as good."""
        ...


RunKind = Literal["trained", "pasted", "removed", "trained or removed"]
"""Kinds of run. For "trained or removed", the content of the pictures decides between the two."""


@dataclass(frozen=True)
class EditorRow:
    """Everything that the program knows about one editor."""

    make: Callable[[EditorInput], ImageEditor]
    example: str  # an example of its option value
    # checks the text after the colon and the options before a new run, without reading the scene
    check: Callable[[str, EditorOptions], object] | None = None
    per_view: bool = False  # edits each view on its own, so nothing makes the views agree
    external: bool = False  # its pictures are made by another program, at fixed strengths
    knows_kind: bool = True  # False if its pictures may change color, style or geometry
    color_function: bool = False  # maps each color to another color, independent of its position
    slow_strengths: bool = False  # runs a model for every strength, so previews must not request them
    run: RunKind = "trained"
    is_parallel: bool = False  # edits views in parallel threads; others run a network or use all cores
    paints_members: bool = False  # it holds a color of every member for each view, which takes memory
    is_manual: bool = False  # set by eye, so a draft is kept whatever its error
    # The next two are never taken from a file without being asked for.
    runs_program: bool = False  # it runs a program that its text names
    sends_pictures: bool = False  # it sends pictures to a server
    model: Callable[[], str] | None = None  # returns the default of `--model`; None: no generative model
    image_size: int = 0  # longer side of its views, pixels; 0 is the default
    views: int = 0  # number of its views; 0 is the default
    files: Callable[[str], tuple[Path, ...]] = lambda what: ()  # picture files that its text names
    shows_scene: bool = False  # its files are pictures of the scene, which may show layers
    sets_views: bool = False  # the views of the run are those of its files
    cameras: Callable[[str], Path | None] = lambda what: None  # camera file beside its pictures, if any
    options: tuple[str, ...] = ()  # fields of `EditorOptions` that apply to it, besides the common ones
    note: Callable[[str], str] = lambda what: ""  # warning before its views are edited; "" if none
    remedy: str = "correct them"  # advice if its views disagree
