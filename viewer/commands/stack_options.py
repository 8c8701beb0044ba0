"""Options of a scene with its edits, drawing options, and the parser. Fast to import."""

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

NO_SCENE = Path()
"""Placeholder for a missing scene."""
SESSION = "--session"
RULES = ("normalized", "sum", "over", "adjust")
"""Blend rules, as `progdf.compose.layers.BLENDS`, whose import takes seconds."""
_BARE_VALUES = {"--split": "0.5", "--difference": "4"}  # value of an option given without one


def word(metavar: str | None = None, absent: str | Callable[[str], str] | None = None, **more: Any) -> Any:
    """Return tyro settings of an option: the placeholder of its value, and its default in the help text."""
    hint = f"(default: {absent})" if isinstance(absent, str) else absent
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint, **more)


def _switch(default: str) -> str:
    return f"(default: {'on' if default == 'True' else 'off'})"


def _scene(default: str) -> str:
    return "(required)" if default != str(NO_SCENE) else "(default: a start page)"


Switch = Annotated[bool, word(absent=_switch)]


@dataclass(frozen=True, kw_only=True)
class StackOptions:
    """Scene with a stack of edits."""

    scene: Annotated[Path, Positional, word("SCENE", _scene)]
    """Scene: .ply, .spz, .splat, .ksplat, .sog, .glb or .gltf; or a session, also as --session FILE."""
    gdfs: Annotated[tuple[Path, ...], Positional, word("EDIT.gdf|SCENE", "the scene alone")] = ()
    """Edits, the lowest layer first; .cube files, which change colors everywhere; further scenes."""
    place: Annotated[tuple[str, ...], UseAppendAction, word("NAME=X,Y,Z[,RX,RY,RZ[,SCALE]]")] = ()
    """Place a scene: a shift, degrees about x, y and z in turn, a scale; see docs/cli.md, Scenes."""
    region: Annotated[tuple[str, ...], UseAppendAction, word("NAME=REGION")] = ()
    """Apply a grade (of any scene) or a .cube file to this region: all, or as for `progdf train`."""
    set: Annotated[tuple[str, ...], UseAppendAction, word("NAME=S")] = ()
    """Strength of an edit, 0 to 1; repeatable. Defaults: see docs/cli.md."""
    gain: Annotated[tuple[str, ...], UseAppendAction, word("NAME:KIND=G")] = ()
    """Gain of one kind of change, 0 to 1: geometry, opacity, color or texture."""
    solo: Annotated[tuple[str, ...], UseAppendAction, word("NAME")] = ()
    """Show this edit alone; repeatable."""
    overshoot: Switch = False
    """Allow strengths up to 1.2 and gains of texture up to 2, which extrapolate."""
    blend: Annotated[tuple[str, ...], UseAppendAction, word("[NAME=]RULE", "the session's, else adjust")] = ()
    """Blend rule for edits that share Gaussians, of all or of one: normalized, sum, over or adjust."""

    def __post_init__(self) -> None:
        for text in self.blend:
            rule = text.rpartition("=")[2]
            if rule not in RULES:
                raise ProgdfError(f"--blend {text}: unknown rule '{rule}'; use one of {', '.join(RULES)}")


@dataclass(frozen=True, kw_only=True)
class DrawingOptions:
    """Drawing settings of a scene."""

    up: UpChoice = "auto"
    """Up axis of the scene; auto: as used to train the edits, else from the ground, else −y."""
    background: Annotated[str, word("COLOR")] = "white"
    """Background: #rrggbb, white or black."""
    engine: Annotated[Literal["auto", "gl", "cpu"], word(aliases=["--draw"])] = "auto"
    """Renderer: OpenGL or the CPU rasterizer; auto uses OpenGL if a graphics card accelerates it."""


def parse(kind: type[Any], argv: Sequence[str], command: str) -> Any:
    """Parse the options of a command.

    `--session FILE` equals FILE as the scene. `--split` and `--difference` without a number get a default.

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
        elif words and words[-1] in _BARE_VALUES and is_number(argument):
            words[-1] += f"={argument}"
        else:
            words.append(argument)
    words = [
        f"{argument}={_BARE_VALUES[argument]}" if argument in _BARE_VALUES else argument for argument in words
    ]
    return parse_options(kind, [*first, *words], command)


def is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
