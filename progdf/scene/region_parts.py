"""Parts of a region's spec that are selected by hand: drawn over a camera's picture, or alike in color.

    PART  = 'rectangle:' CAMERA ':' x0,y0,x1,y1       two opposite corners, pixels of the camera
          | 'lasso:' CAMERA ':' x,y,x,y,x,y[,x,y…]    inside the outline through these points
          | 'brush:' CAMERA ':' r,x,y[,x,y…]          under a round brush of radius r along these points
          | 'front:' CAMERA                           what the camera sees and nothing hides
          | 'color:' #rrggbb [',' tolerance]          base colors no farther from this one, OKLab
          | 'flood:' x,y,z [',' tolerance]            connected with what is nearest, and alike in color
    STEP  = 'grow' | 'shrink' | 'smooth' [':' times] | 'largest'

CAMERA is FILE[:INDEX], as `--camera` has it; a picture that carries its camera is such a file. Shapes go
through the scene; '&front:CAMERA' leaves what is in front.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from PIL import ImageColor

from progdf.camera import Camera
from progdf.color.oklab import srgb_to_oklab
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians
from progdf.io.cameras import read_camera

from .neighborhood import Neighborhood, grow_along_surface
from .selection import (
    Mask,
    alike_in_color,
    base_colors,
    front_surface,
    inside_polygon,
    inside_rectangle,
    inside_stroke,
    project_centers,
)

TOLERANCE = 0.08
"""How far colors may be from the one that is named where the spec does not say. A click on a black jacket
takes the leather, and at .1 the hair too."""

MOST_TIMES = 100

LARGEST = 1e18
"""Of numbers in a region, on either side of 0: the squares of a few of them still are float32."""

Selecting = Callable[[Gaussians], Mask]
"""What a checked part does with a scene."""


def read_part(kind: str, rest: str) -> Selecting:
    """What a part of one of `PARTS` selects.

    Raises:
        ProgdfError: no scene can have it: its numbers or its camera cannot be read.
    """
    if kind == "color":
        code, tolerance = _with_tolerance(kind, rest, 1, "#rrggbb[,tolerance]")
        lab = _oklab(rest, code[0])
        return lambda scene: alike_in_color(base_colors(scene), lab, tolerance)
    if kind == "flood":
        words, tolerance = _with_tolerance(kind, rest, 3, "x,y,z[,tolerance]")
        x, y, z = _numbers(kind, rest, ",".join(words), "x,y,z[,tolerance]")
        return lambda scene: _flood(scene, (x, y, z), tolerance)
    if kind == "front":
        camera_of = _camera(kind, rest, "CAMERA")
        return lambda scene: _front(scene, camera_of(scene))
    form, least, odd = _FORMS[kind]
    where, _, text = rest.rpartition(":")
    camera_of, numbers = _camera(kind, where, f"CAMERA:{form}"), _numbers(kind, rest, text, f"CAMERA:{form}")
    if len(numbers) < least or len(numbers) % 2 != odd or (kind == "rectangle" and len(numbers) > least):
        raise ProgdfError(
            f"region '{kind}:{shorten(rest)}' has {len(numbers)} numbers; write {kind}:CAMERA:{form}"
        )
    if odd and numbers[0] <= 0:
        raise ProgdfError(
            f"the radius in region '{kind}:{shorten(rest)}' is {numbers[0]:g}; it must be positive"
        )
    return partial(_inside, kind, camera_of, numbers)


def read_step(text: str) -> Callable[[Neighborhood, Mask], Mask]:
    """What `grow:3` or another of `STEPS` does with a selection.

    Raises:
        ProgdfError: it is none of them, or not so many times.
    """
    name, _, times = text.partition(":")
    count = int(times) if re.fullmatch(r"[0-9]{1,9}", times) else 1 if not times else 0
    if name not in STEPS or not 1 <= count <= (1 if name == "largest" else MOST_TIMES):
        raise ProgdfError(
            f"'{shorten(text)}' is no step of a region; write grow, shrink or smooth:TIMES, "
            f"at most {MOST_TIMES}, or largest"
        )

    def step(neighborhood: Neighborhood, mask: Mask) -> Mask:
        for _ in range(count):
            mask = STEPS[name](neighborhood, mask)
        return mask

    return step


def _front(scene: Gaussians, camera: Camera) -> Mask:
    return front_surface(scene, camera, project_centers(scene, camera))


def _inside(
    kind: str, camera_of: Callable[[Gaussians], Camera], numbers: list[float], scene: Gaussians
) -> Mask:
    points = project_centers(scene, camera_of(scene)).points
    if kind == "rectangle":
        return inside_rectangle(points, numbers[:2], numbers[2:])
    if kind == "lasso":
        return inside_polygon(points, np.reshape(numbers, (-1, 2)))
    return inside_stroke(points, np.reshape(numbers[1:], (-1, 2)), numbers[0])


def _flood(scene: Gaussians, point: tuple[float, float, float], tolerance: float) -> Mask:
    neighborhood, colors = Neighborhood(scene), base_colors(scene)
    seed = neighborhood.nearest(tuple(np.subtract(point, scene.origin).tolist()))
    return grow_along_surface(neighborhood, colors, np.array([seed]), colors[seed], tolerance)


def _camera(kind: str, text: str, form: str) -> Callable[[Gaussians], Camera]:
    """Gives the camera for a scene, which it is relative to; that it can be read is checked at once."""
    if not text:
        raise ProgdfError(f"{kind}: needs a camera; write {kind}:{form}, CAMERA as --camera has it")
    read_camera(text, ZERO)
    return lambda scene: read_camera(text, scene.origin)


def _with_tolerance(kind: str, rest: str, count: int, form: str) -> tuple[list[str], float]:
    words = rest.split(",")
    if not count <= len(words) <= count + 1:
        raise ProgdfError(f"region '{kind}:{shorten(rest)}' cannot be read; write {kind}:{form}")
    tolerance = _numbers(kind, rest, words[count], form)[0] if len(words) > count else TOLERANCE
    if not 0 < tolerance <= 1:
        raise ProgdfError(
            f"the tolerance in region '{kind}:{shorten(rest)}' is {tolerance:g}; write above 0, up to 1"
        )
    return words[:count], tolerance


def _numbers(kind: str, rest: str, text: str, form: str) -> list[float]:
    numbers = read_numbers(text)
    if not numbers:
        raise ProgdfError(
            f"region '{kind}:{shorten(rest)}' does not end in numbers up to {LARGEST:g}; write {kind}:{form}"
        )
    return numbers


def read_numbers(text: str) -> list[float]:
    """Numbers between commas, none beyond `LARGEST`; [] where it is anything else."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        return []
    return numbers if all(abs(number) <= LARGEST for number in numbers) else []


def shorten(text: str) -> str:
    """What somebody typed, as a message repeats it."""
    return text if len(text) <= 80 else f"{text[:79]}…"


def _oklab(rest: str, code: str) -> list[float]:
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", code.strip()):
        raise ProgdfError(
            f"'{shorten(code)}' in region 'color:{shorten(rest)}' is not a color; "
            "write for example color:#903020"
        )
    rgb = torch.tensor(ImageColor.getrgb(code.strip())[:3]) / 255.0
    lab: list[float] = srgb_to_oklab(rgb).tolist()
    return lab


_FORMS = {
    "rectangle": ("x0,y0,x1,y1", 4, 0),
    "lasso": ("x,y,x,y,x,y,…", 6, 0),
    "brush": ("radius,x,y,…", 3, 1),
}

PARTS = (*_FORMS, "front", "color", "flood")
STEPS: dict[str, Callable[[Neighborhood, Mask], Mask]] = {
    "grow": Neighborhood.grow,
    "shrink": Neighborhood.shrink,
    "smooth": Neighborhood.smooth,
    "largest": Neighborhood.largest_part,
}
