"""The options of a scene under its edits and of how it is drawn, and the parser: imported in a moment."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, UseAppendAction

from progdf.cli.options import parse_options
from progdf.errors import ProgdfError
from progdf.scene import UpChoice

Blend = Literal["normalized", "sum", "over", "adjust"]
NO_SCENE = Path()
"""What stands for the scene where none is given."""
SESSION = "--session"
_BARE = {"--split": "0.5", "--difference": "4"}  # what an option without a value means


def word(metavar: str | None = None, absent: str | Callable[[str], str] | None = None, **more: Any) -> Any:
    """How help shows an option: what stands for its value, and what happens without it."""
    hint = f"(default: {absent})" if isinstance(absent, str) else absent
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint, **more)


def _switch(default: str) -> str:
    return f"(default: {'on' if default == 'True' else 'off'})"


def _scene(default: str) -> str:
    return "(required)" if default != str(NO_SCENE) else "(default: a start page)"


Switch = Annotated[bool, word(absent=_switch)]


@dataclass(frozen=True, kw_only=True)
class StackOptions:
    """A scene under a stack of edits."""

    scene: Annotated[Path, Positional, word("SCENE", _scene)]
    """The scene: a .ply, .spz, .splat, .ksplat, .sog, .glb or .gltf; or a session, also as --session FILE."""
    gdfs: Annotated[tuple[Path, ...], Positional, word("EDIT.gdf", "the scene alone")] = ()
    """Edits of this scene, the lowest layer first; also .cube files, which change colors everywhere."""
    region: Annotated[tuple[str, ...], UseAppendAction, word("NAME=REGION")] = ()
    """Apply the grade of an edit, of whatever scene, or a .cube file to a region of this scene: all, or as
    `progdf train` has it."""
    set: Annotated[tuple[str, ...], UseAppendAction, word("NAME=S")] = ()
    """Strength of an edit, 0 to 1; repeat it for several edits. An edit that is not named is at 1 in `render`
    and `export`, at 0 in `view`, --sweep and --sheet, and as a session has it."""
    gain: Annotated[tuple[str, ...], UseAppendAction, word("NAME:KIND=G")] = ()
    """How much of one kind of change an edit lets through, 0 to 1: geometry, opacity or color."""
    solo: Annotated[tuple[str, ...], UseAppendAction, word("NAME")] = ()
    """Show this edit alone. Repeat it for several edits."""
    overshoot: Switch = False
    """Overshoot to 1.2: extrapolates past the trained range."""
    blend: Annotated[Blend | None, word("{normalized,sum,over,adjust}", "the session's, else adjust")] = None
    """How edits that share Gaussians add up."""


@dataclass(frozen=True, kw_only=True)
class DrawingOptions:
    """How the stack is drawn."""

    up: UpChoice = "auto"
    """The axis of the scene that is up; auto: as the edits were trained, else from the ground, else −y."""
    background: Annotated[str, word("COLOR")] = "white"
    """#rrggbb, white or black."""
    engine: Annotated[Literal["auto", "gl", "cpu"], word(aliases=["--draw"])] = "auto"
    """What draws: OpenGL or the CPU rasterizer; auto takes OpenGL where a graphics card does the work."""


def parse(kind: type[Any], argv: Sequence[str], command: str) -> Any:
    """The options of a command. `--session FILE` is FILE in the scene's place; `--split` and `--difference`
    without a number get theirs.

    Raises:
        ProgdfError: an option is missing, unknown or of the wrong kind.
    """
    first: list[str] = []
    words: list[str] = []
    remaining = iter(argv)
    for argument in remaining:
        if argument == SESSION:
            file = next(remaining, None)
            if file is None:
                raise ProgdfError(f"{SESSION} needs a file; write {SESSION} FILE")
            first.append(file)
        elif argument.startswith(f"{SESSION}="):
            first.append(argument.removeprefix(f"{SESSION}="))
        elif words and words[-1] in _BARE and is_number(argument):
            words[-1] += f"={argument}"
        else:
            words.append(argument)
    words = [f"{argument}={_BARE[argument]}" if argument in _BARE else argument for argument in words]
    return parse_options(kind, [*first, *words], command)


def is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
