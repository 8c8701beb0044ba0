"""What people type after `progdf render` and `progdf export`, taken apart; each mistake is one clear line."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

from progdf.camera import Camera
from progdf.color.edits import parse_color
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.io.cameras import read_camera
from viewer.camera.view_camera import (
    FARTHEST,
    Vec3,
    ViewCamera,
    bounds_of,
    first_camera,
    fit,
    fit_subject,
    frame,
    to_camera,
)
from viewer.state.layers import visible_layers
from viewer.state.view_state import MOST_AMPLIFIED, Comparison, LayerState, ViewState

from .options import RenderOptions

LARGEST_SIDE = 16_384
_BARE = {"--split": "0.5", "--difference": "4"}  # what an option without a value means


class Named(Protocol):
    """An edit, or the layer that shows one."""

    @property
    def name(self) -> str:
        """No two of a stack share one."""


def layers_of(
    gdfs: Sequence[Gdf], settings: Sequence[str], most: float = 1.0, unset: float = 0.0
) -> tuple[LayerState, ...]:
    """One layer per edit, at `unset` unless a `NAME=S` of `settings` says otherwise.

    Raises:
        ProgdfError: there is no edit NAME, or S is no number from 0 to `most`.
    """
    strengths = strengths_of(gdfs, settings, most)
    return tuple(LayerState(i, gdf.name, strengths.get(gdf.name, unset)) for i, gdf in enumerate(gdfs))


def strengths_of(edits: Sequence[Named], settings: Sequence[str], most: float = 1.0) -> dict[str, float]:
    """The strengths that settings `NAME=S` name.

    Raises:
        ProgdfError: see `layers_of`.
    """
    strengths = {}
    for setting in settings:
        name, equals, text = setting.rpartition("=")
        if not equals or not name:
            raise ProgdfError(
                f"--set {setting} is not NAME=S; write, for example, --set {_example(edits)}=0.7"
            )
        strengths[known_edit(name, edits, "--set")] = _strength(setting, text, most)
    return strengths


def describe_strengths(view: ViewState) -> str:
    """The layers that take part, each with its strength."""
    return ", ".join(f"{layer.name} {layer.strength:g}" for layer in visible_layers(view)) or "no edits"


def known_edit(name: str, gdfs: Sequence[Named], option: str) -> str:
    """`name`, when an edit has it.

    Raises:
        ProgdfError: none has; the message lists those there are.
    """
    if name in {gdf.name for gdf in gdfs}:
        return name
    if not gdfs:
        raise ProgdfError(f"{option} {name}: no .gdf file was given; name one after the scene")
    names = ", ".join(gdf.name for gdf in gdfs)
    raise ProgdfError(f"{option} {name}: there is no edit of that name; there {_list_names(gdfs)} {names}")


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of `WxH`, pixels.

    Raises:
        ProgdfError: it is no size, or one that no picture should have.
    """
    width, cross, height = text.lower().partition("x")
    if not cross or not all(re.fullmatch(r"[0-9]{1,9}", side) for side in (width, height)):
        raise ProgdfError(f"--size {text} is not a size; write it as WIDTHxHEIGHT, for example 640x480")
    size = int(width), int(height)
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        raise ProgdfError(f"--size {text} cannot be drawn; each side may be 1 to {LARGEST_SIDE} pixels")
    return size


def parse_orbit(text: str, framed: ViewCamera) -> ViewCamera:
    """The camera of `AZIMUTH,ELEVATION[,DISTANCE]`: degrees, degrees above the horizon, world units.

    Args:
        text: what was typed
        framed: shows the scene; gives the pivot, the up axis, and the distance where none is said

    Raises:
        ProgdfError: it is not two or three finite numbers, or the camera cannot stand there.
    """
    right = "write AZIMUTH,ELEVATION or AZIMUTH,ELEVATION,DISTANCE, for example --orbit 30,15"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise ProgdfError(f"--orbit {text} is not a list of numbers; {right}") from None
    if len(numbers) not in (2, 3) or not all(math.isfinite(number) for number in numbers):
        raise ProgdfError(f"--orbit {text} is not two or three numbers; {right}")
    if not -90 <= numbers[1] <= 90:
        raise ProgdfError(
            f"--orbit {text}: the elevation must be between -90 and 90 degrees, got {numbers[1]:g}"
        )
    distance = numbers[2] if len(numbers) == 3 else framed.distance
    if not 0 < distance <= FARTHEST:
        raise ProgdfError(
            f"--orbit {text}: the distance must be above 0 and at most {FARTHEST:g}, got {distance:g}"
        )
    return replace(framed, azimuth=numbers[0], elevation=numbers[1], distance=distance)


def fit_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same view in another size, undistorted: the same height of the scene, the sides cut or widened."""
    width, height = size
    scale = height / camera.height
    K = camera.K * scale
    K[2, 2] = 1.0
    K[0, 2] = width / 2 + (camera.K[0, 2] - camera.width / 2) * scale
    return replace(camera, K=K, width=width, height=height)


def parse_comparison(split: str | None, amplify: str | None) -> Comparison:
    """What `--split X` or `--difference AMPLIFY` asks for; neither is no comparison.

    Raises:
        ProgdfError: X is no number from 0 to 1, or AMPLIFY none from 1 to 64.
    """
    if split is not None:
        if not is_number(split) or not 0.0 <= float(split) <= 1.0:
            raise ProgdfError(f"--split must be between 0 and 1, got {split}")
        return Comparison("split", divider=float(split))
    if amplify is not None:
        if not is_number(amplify) or not 1.0 <= float(amplify) <= MOST_AMPLIFIED:
            raise ProgdfError(f"--difference must be between 1 and {MOST_AMPLIFIED:g}, got {amplify}")
        return Comparison("difference", amplify=float(amplify))
    return Comparison()


def join_arguments(argv: Sequence[str]) -> list[str]:
    """`--split` and `--difference` without a number get theirs."""
    found: list[str] = []
    for argument in argv:
        if found and found[-1] in _BARE and is_number(argument):
            found[-1] = f"{found[-1]}={argument}"
        else:
            found.append(argument)
    return [f"{argument}={_BARE[argument]}" if argument in _BARE else argument for argument in found]


def is_number(text: str) -> bool:
    """Whether `text` is a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def parse_background(text: str) -> Vec3:
    """The color of `#rrggbb`, "white" or "black", 0..1.

    Raises:
        ProgdfError: it is no color.
    """
    red, green, blue = parse_color({"white": "#ffffff", "black": "#000000"}.get(text.lower(), text)).tolist()
    return red, green, blue


def _strength(setting: str, text: str, most: float) -> float:
    try:
        strength = float(text)
    except ValueError:
        strength = math.nan
    if not 0.0 <= strength <= most:
        raise ProgdfError(f"--set {setting}: the strength '{text}' is not a number from 0 to {most:g}")
    return strength


def _example(gdfs: Sequence[Named]) -> str:
    return gdfs[0].name if gdfs else "NAME"


def _list_names(gdfs: Sequence[Named]) -> str:
    return "is" if len(gdfs) == 1 else "are"


DEFAULT_SIZE = (640, 480)


def choose_camera(
    options: RenderOptions,
    scene: Gaussians,
    gdfs: Sequence[Gdf],
    size: tuple[int, int] | None,
    saved: ViewCamera | None,
    up: Vec3 | None = None,
) -> Camera:
    """The camera that was asked for; that of the session (`saved`); or one that frames the scene.

    Args:
        options: camera, orbit and frame of it
        scene: the original
        gdfs: its edits, which --frame may name
        size: (width, height) in pixels; None: the camera's own, or `DEFAULT_SIZE`
        saved: of a session
        up: unit vector that is up in the scene; None finds it

    Raises:
        ProgdfError: options that contradict each other or name nothing.
    """
    if options.camera is not None and options.orbit is not None:
        raise ProgdfError("--camera and --orbit cannot be combined; give only one of them")
    if options.camera is not None:
        if options.frame is not None:
            raise ProgdfError("--camera and --frame cannot be combined; give only one of them")
        camera = read_camera(options.camera, scene.origin)
        return camera if size is None else fit_camera(camera, size)
    width, height = size or DEFAULT_SIZE
    aspect = width / height
    view = saved or first_camera(scene, aspect=aspect, up=up)
    if options.orbit is not None:
        view = parse_orbit(options.orbit, view)
    if options.frame is not None or (options.orbit is not None and saved is None):
        view = _frame_on(view, options.frame, scene, gdfs, aspect)
        if options.orbit is not None:  # a distance that was said holds
            view = parse_orbit(options.orbit, view)
    return to_camera(view, width, height)


def _frame_on(
    view: ViewCamera, name: str | None, scene: Gaussians, gdfs: Sequence[Gdf], aspect: float
) -> ViewCamera:
    """The same direction, filled by what --frame names."""
    if name is None:
        return fit_subject(view, scene, aspect)
    if name == "all" and name not in [gdf.name for gdf in gdfs]:
        return frame(view, bounds_of(scene), aspect)
    known = known_edit(name, gdfs, "--frame")
    (members,) = (gdf.region.members for gdf in gdfs if gdf.name == known)
    return fit(view, scene[members], aspect)
