"""Text form of a region, such as `labels:bear.npy:3,4-box:0,0,0,1,2,1`.

A region is read from left to right:

    REGION  = PART (SIGN PART | '|' STEP)*
    SIGN    = '+' union | '-' difference | '&' intersection
    STEP    = ('grow' | 'shrink' | 'smooth') [':' TIMES] | 'largest' | 'refine' [':' PERCENT]

Parts by number, in world units:

    'all'
    'labels:' FILE '.npy:' ID (',' ID)*
    'box:' x0,y0,z0,x1,y1,z1             Two opposite corners.
    'sphere:' x,y,z,r                    Center and radius.
    'file:' FILE.npy                     Rows (integers), or a bool for each Gaussian.

Parts of a picture, in pixels:

    'rectangle:' CAMERA ':' x0,y0,x1,y1  Two opposite corners.
    'lasso:' CAMERA ':' x,y,x,y,x,y,…    Corners of a polygon.
    'brush:' CAMERA ':' radius,x,y,…     Points of a stroke.
    'front:' CAMERA                      Gaussians on the surface that the camera sees.

Parts by color or shape:

    'color:' #rrggbb[,tolerance]           Gaussians of similar color.
    'flood:' x,y,z[,tolerance]             Similar color, connected with the Gaussian nearest to a point.
    'flood:' CAMERA ':' x,y[,tolerance]    Color of a pixel, connected with the Gaussians in it.
    'subject' [':' CAMERA]                 Object in the middle of a view, by default the scene's first.

The caller may support further kinds, such as `masks:`, `text:` and `changed`.

Numbers and file names may contain '-' and '+'. A sign therefore joins two parts only before a kind with its
colon, a whole 'all', or a step. Blanks around parts do not count.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.camera import Camera
from progdf.color.edits import parse_color
from progdf.color.oklab import srgb_to_oklab
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians
from progdf.io.cameras import read_camera
from progdf.io.tensors import open_npy
from progdf.region import (
    Region,
    difference,
    from_labels,
    from_mask,
    inside_box,
    inside_sphere,
    intersection,
    union,
    whole_scene,
)
from progdf.terminal import format_count, format_place, shorten

from . import selection
from .neighbors import RIM_PERCENT, Neighborhood, grow_along_surface
from .selection import Mask
from .subject import first_view, select_subject
from .up_axis import guess_up

TOLERANCE = 0.08
"""Default tolerance of a color, as a distance in OKLab. On a black jacket 0.08 selects the leather, and 0.1
also the hair."""

FIRST_VIEW_PX = (640, 480)
"""Width and height of the view of `subject` without a camera, as `progdf render` draws it; pixels."""

MAX_TIMES = 100
"""Largest number of repetitions of a step."""

MAX_NUMBER = 1e18
"""Largest magnitude of a number in a region. The sum of a few squares still fits float32."""

PartSelector = Callable[[Gaussians], Mask]
"""Function from a scene to the mask that a part selects."""


def read_part(kind: str, argument: str) -> PartSelector:
    """Return the selection function of a part whose kind is one of `PARTS`.

    Raises:
        ProgdfError: the numbers or the camera cannot be read.
    """
    if kind == "color":
        code, tolerance = _with_tolerance(kind, argument, 1, "#rrggbb[,tolerance]")
        lab = _oklab(argument, code[0])
        return lambda scene: selection.alike_in_color(selection.base_colors(scene), lab, tolerance)
    if kind == "flood" and ":" in argument:
        form = "CAMERA:x,y[,tolerance]"
        camera_text, _, text = argument.rpartition(":")
        camera_of = _camera(kind, camera_text, form)
        words, tolerance = _with_tolerance(kind, text, 2, form)
        x, y = _final_numbers(kind, argument, ",".join(words), form)
        return lambda scene: _flood_from_pixel(scene, camera_of(scene), (x, y), tolerance)
    if kind == "flood":
        words, tolerance = _with_tolerance(kind, argument, 3, "x,y,z[,tolerance]")
        x, y, z = _final_numbers(kind, argument, ",".join(words), "x,y,z[,tolerance]")
        return lambda scene: _flood(scene, (x, y, z), tolerance)
    if kind == "subject":
        view_of = _camera(kind, argument, "CAMERA") if argument else _first_view
        return lambda scene: _subject(scene, view_of)
    if kind == "front":
        camera_of = _camera(kind, argument, "CAMERA")
        return lambda scene: _front(scene, camera_of(scene))
    form, min_count, parity = _SHAPE_FORMS[kind]
    camera_text, _, text = argument.rpartition(":")
    camera_of = _camera(kind, camera_text, f"CAMERA:{form}")
    numbers = _final_numbers(kind, argument, text, f"CAMERA:{form}")
    if (
        len(numbers) < min_count
        or len(numbers) % 2 != parity
        or (kind == "rectangle" and len(numbers) > min_count)
    ):
        raise ProgdfError(
            f"region '{kind}:{shorten(argument)}' has {len(numbers)} numbers; write {kind}:CAMERA:{form}"
        )
    if parity and numbers[0] <= 0:
        raise ProgdfError(
            f"the radius in region '{kind}:{shorten(argument)}' is {numbers[0]:g}; it must be positive"
        )
    return partial(_inside, kind, camera_of, numbers)


def read_step(text: str) -> Callable[[Neighborhood, Mask], Mask]:
    """Return the function of a step such as `grow:3`, see `STEPS`.

    Raises:
        ProgdfError: the step is unknown, or its number is out of range.
    """
    name, _, times = text.partition(":")
    count = 1 if not times else 0
    if re.fullmatch(r"[0-9]{1,9}", times):
        count = int(times)
    max_count = 1 if name == "largest" else MAX_TIMES
    if name == "refine" and 1 <= count <= 100:
        return lambda neighborhood, mask: neighborhood.refine(mask, count if times else RIM_PERCENT)
    if name not in STEPS or not 1 <= count <= max_count:
        raise ProgdfError(
            f"invalid region step '{shorten(text)}'; write grow, shrink or smooth:TIMES, "
            f"at most {MAX_TIMES}, refine:PERCENT, or largest"
        )

    def step(neighborhood: Neighborhood, mask: Mask) -> Mask:
        for _ in range(count):
            mask = STEPS[name](neighborhood, mask)
        return mask

    return step


def _front(scene: Gaussians, camera: Camera) -> Mask:
    return selection.front_surface(scene, camera, selection.project_centers(scene, camera))


def _inside(
    kind: str, camera_of: Callable[[Gaussians], Camera], numbers: list[float], scene: Gaussians
) -> Mask:
    points = selection.project_centers(scene, camera_of(scene)).points
    if kind == "rectangle":
        return selection.inside_rectangle(points, numbers[:2], numbers[2:])
    if kind == "lasso":
        return selection.inside_polygon(points, np.reshape(numbers, (-1, 2)))
    return selection.inside_stroke(points, np.reshape(numbers[1:], (-1, 2)), numbers[0])


def _flood(scene: Gaussians, point: tuple[float, float, float], tolerance: float) -> Mask:
    neighborhood = Neighborhood(scene)
    colors = selection.base_colors(scene)
    seed = neighborhood.nearest(tuple(np.subtract(point, scene.origin).tolist()))
    return grow_along_surface(neighborhood, colors, np.array([seed]), colors[seed], tolerance)


def _flood_from_pixel(scene: Gaussians, camera: Camera, at: tuple[float, float], tolerance: float) -> Mask:
    """Select the connected Gaussians that show the color of a pixel; none for a pixel outside the picture."""
    nothing = np.zeros(len(scene), bool)
    if not (0 <= at[0] < camera.width and 0 <= at[1] < camera.height):
        return nothing
    rows, shares = selection.rows_at_pixel(scene, camera, *at)
    if not len(rows):
        return nothing
    colors = selection.shown_colors(scene, camera, _front(scene, camera))
    color = selection.pixel_color(scene, camera, *at)
    seeds = selection.main_rows(rows, shares)
    return grow_along_surface(Neighborhood(scene), colors, seeds, color, tolerance)


def _subject(scene: Gaussians, view_of: Callable[[Gaussians], Camera]) -> Mask:
    """Return the Gaussians of the subject in a scene's view; none in an empty scene, which has no view."""
    if not len(scene):
        return np.zeros(0, bool)
    camera = view_of(scene)
    return select_subject(scene, Neighborhood(scene), camera, guess_up(scene))


def _first_view(scene: Gaussians) -> Camera:
    return first_view(scene, guess_up(scene), FIRST_VIEW_PX)


def _camera(kind: str, text: str, form: str) -> Callable[[Gaussians], Camera]:
    """Check that a camera can be read; return a function that gives it relative to a scene."""
    if not text:
        raise ProgdfError(f"{kind}: needs a camera; write {kind}:{form}, with CAMERA as for --camera")
    read_camera(text, ZERO)
    return lambda scene: read_camera(text, scene.origin)


def _with_tolerance(kind: str, text: str, count: int, form: str) -> tuple[list[str], float]:
    words = text.split(",")
    if not count <= len(words) <= count + 1:
        raise ProgdfError(f"region '{kind}:{shorten(text)}' cannot be read; write {kind}:{form}")
    tolerance = _final_numbers(kind, text, words[count], form)[0] if len(words) > count else TOLERANCE
    if not 0 < tolerance <= 1:
        raise ProgdfError(
            f"the tolerance in region '{kind}:{shorten(text)}' is {tolerance:g}; write above 0, up to 1"
        )
    return words[:count], tolerance


def _final_numbers(kind: str, typed: str, text: str, form: str) -> list[float]:
    numbers = read_numbers(text)
    if not numbers:
        raise ProgdfError(
            f"region '{kind}:{shorten(typed)}' does not end in numbers up to {MAX_NUMBER:g}; "
            f"write {kind}:{form}"
        )
    return numbers


def read_numbers(text: str) -> list[float]:
    """Return the numbers between commas; [] if one cannot be read or exceeds `MAX_NUMBER`."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        return []
    return numbers if all(abs(number) <= MAX_NUMBER for number in numbers) else []


def _oklab(text: str, code: str) -> list[float]:
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", code.strip()):
        raise ProgdfError(
            f"'{shorten(code)}' in region 'color:{shorten(text)}' is not a color; "
            "write for example color:#903020"
        )
    lab: list[float] = srgb_to_oklab(parse_color(code)).tolist()
    return lab


# form of the numbers after CAMERA:, their smallest count, and the count modulo 2
_SHAPE_FORMS = {
    "rectangle": ("x0,y0,x1,y1", 4, 0),
    "lasso": ("x,y,x,y,x,y,…", 6, 0),
    "brush": ("radius,x,y,…", 3, 1),
}

PARTS = (*_SHAPE_FORMS, "front", "color", "flood", "subject")
"""Kinds of parts that are drawn or picked in the window."""
STEPS: dict[str, Callable[[Neighborhood, Mask], Mask]] = {
    "grow": Neighborhood.grow,
    "shrink": Neighborhood.shrink,
    "smooth": Neighborhood.smooth,
    "largest": Neighborhood.largest_part,
    "refine": Neighborhood.refine,
}


Kind = Callable[[str, Gaussians], Region]
"""Function that makes a region from the text after `KIND:`."""

Check = Callable[[str], object]
"""Function that raises ProgdfError if the text after `KIND:` is invalid for every scene."""

_log = logging.getLogger(__name__)

_MIN_FLOOD_GAUSSIANS = 10  # Gaussians; a smaller flood is a stray and its neighbors

_SIGNS = {"+": union, "-": difference, "&": intersection}
_NO_KINDS: Mapping[str, Kind] = {}
_NO_CHECKS: Mapping[str, Check] = {}

KINDS_WITHOUT_ARGUMENT = ("changed", "subject")
"""Kinds that need no colon and no text."""


def parse_region(
    spec: str,
    scene: Gaussians,
    name: str = "",
    kinds: Mapping[str, Kind] = _NO_KINDS,
    say: Callable[[str], None] = _log.warning,
) -> Region:
    """Return the region that `spec` describes in `scene`.

    Args:
        spec: see the head of this file
        name: the region's name; the spec itself if empty
        kinds: further kinds by name, e.g. {"masks": lift_from_folder}
        say: receives one line for each part that selects nothing or probably not the intended Gaussians

    Raises:
        ProgdfError: the spec cannot be read, a file does not fit the scene, or the region is empty.
    """
    known: dict[str, Kind] = {"labels": _labels, "box": _box, "sphere": _sphere, "file": _file}
    known |= {kind: partial(_drawn, kind) for kind in PARTS} | dict(kinds)
    region = from_mask("", torch.zeros(len(scene), dtype=torch.bool))
    neighborhood: Neighborhood | None = None
    for sign, part in split_spec(spec, tuple(known)):
        if sign == "|":
            neighborhood = neighborhood or Neighborhood(scene)
            mask = read_step(part)(neighborhood, region.mask.numpy())
            joined = from_mask("", torch.from_numpy(mask))
        else:
            kind, colon, text = part.partition(":")
            if part == "all":
                selected = whole_scene(scene)
            elif kind in known and (colon or kind in KINDS_WITHOUT_ARGUMENT):
                selected = known[kind](text, scene)
            else:
                raise _unknown_region(part, known)
            warning = _doubt(kind, len(selected), len(scene))
            if warning:
                say(f"{shorten(part)} {warning}")
            joined = _SIGNS[sign](region, selected)
        if len(region) and not len(joined):
            say(f"the region is empty after {sign}{shorten(part)}")
        region = joined
    if not len(scene):
        raise ProgdfError(f"region '{shorten(spec)}' holds no Gaussian, because the scene has none")
    if not len(region):
        raise ProgdfError(f"region '{shorten(spec)}' holds no Gaussian; the scene spans {_extent(scene)}")
    return Region(name or spec.strip(), region.members, region.score)


def _doubt(kind: str, count: int, total: int) -> str:
    """Return a warning if a part that selects `count` of `total` Gaussians is probably unintended, or ""."""
    if not count:
        return "selects no Gaussian"
    if kind == "flood" and count < _MIN_FLOOD_GAUSSIANS:
        return f"selects only {format_count(count)}; raise its tolerance, or name a point on a surface"
    if kind == "color" and 2 * count > total:
        return f"selects {100 * count / total:.0f} % of the scene; lower its tolerance, or add &box:…"
    return ""


def check_region(spec: str, checks: Mapping[str, Check] = _NO_CHECKS) -> None:
    """Check a region as far as possible before a scene is loaded.

    Args:
        spec: see the head of this file
        checks: checks of further kinds by name

    Raises:
        ProgdfError: no scene can have this region.
    """
    known: dict[str, Check] = {
        "labels": _check_labels,
        "box": _corners,
        "sphere": _ball,
        "file": _check_file,
        **{kind: partial(read_part, kind) for kind in PARTS},
        **checks,
    }
    for sign, part in split_spec(spec, tuple(known)):
        kind, colon, text = part.partition(":")
        if sign == "|":
            read_step(part)
        elif kind in known and (colon or kind in KINDS_WITHOUT_ARGUMENT):
            known[kind](text)
        elif part != "all":
            raise _unknown_region(part, known)


def _unknown_region(part: str, known: Iterable[str]) -> ProgdfError:
    choice = ", ".join(["all", *(word if word in KINDS_WITHOUT_ARGUMENT else f"{word}:…" for word in known)])
    return ProgdfError(f"unknown region '{shorten(part)}'; write {choice}")


def split_spec(spec: str, kinds: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return the (sign, part) pairs of a spec. The first sign is '+', and a step's sign is '|'."""
    words = "|".join(re.escape(kind) for kind in kinds)
    steps = "|".join(re.escape(step) for step in STEPS)
    bare = "|".join(("all", *KINDS_WITHOUT_ARGUMENT))
    part = rf"(?:{words}):|(?:{bare})\s*(?:$|[+&|-])"
    step_part = rf"(?:{steps})(?::-?[^\s+&|-]*)?\s*(?:$|[+&|-])"
    # no blanks before the sign: a pattern that begins with blanks takes quadratic time on a run of them
    pieces = [piece.strip() for piece in re.split(rf"([+&-](?=\s*(?:{part}))|\|(?=\s*{step_part}))", spec)]
    if not all(pieces[0::2]):
        raise ProgdfError(
            f"region '{shorten(spec)}' is missing a part; write, for example, all-sphere:0,0,0,1"
        )
    return list(zip(["+", *pieces[1::2]], pieces[0::2], strict=True))


def _drawn(kind: str, text: str, scene: Gaussians) -> Region:
    return from_mask(f"{kind}:{text}", torch.from_numpy(read_part(kind, text)(scene)))


def read_labels(path: str, count: int) -> Tensor:
    """Read one integer label per Gaussian from a .npy file. [count] int64

    Raises:
        ProgdfError: the file is missing, is not a .npy file, or does not hold one integer per Gaussian.
    """
    labels = _open_labels(path)
    if labels.shape not in ((count,), (count, 1)):
        shape = "x".join(str(side) for side in labels.shape) or "1"
        raise ProgdfError(
            f"{path} holds {shape} labels, the scene has {count} Gaussians; give one label for each"
        )
    return torch.from_numpy(labels.reshape(-1).astype(np.int64))


def read_members(path: str, count: int) -> Tensor:
    """Read rows from a .npy file of integers or of one bool per Gaussian. Sorted and unique, [M] int64

    Raises:
        ProgdfError: the file is missing, not a .npy, of the wrong type, or names rows outside the scene.
    """
    stored = _open_members(path)
    if stored.dtype.kind == "b":
        if stored.shape != (count,):
            shape = "x".join(str(side) for side in stored.shape) or "1"
            raise ProgdfError(
                f"{path} is a mask of {shape}, the scene has {count} Gaussians; give a mask of this scene"
            )
        return torch.from_numpy(np.flatnonzero(stored))
    if stored.dtype.kind not in "iu" or stored.ndim != 1:
        raise ProgdfError(
            f"{path} holds {stored.dtype} numbers of {stored.ndim} dimensions; "
            "give a list of integer rows, or a bool for each Gaussian"
        )
    if len(stored) and not 0 <= int(stored.min()) <= int(stored.max()) < count:
        raise ProgdfError(
            f"{path} names row {int(stored.min() if stored.min() < 0 else stored.max())}, "
            f"the scene has rows 0 to {count - 1}; it was made for another scene"
        )
    return torch.from_numpy(np.unique(stored).astype(np.int64))


def _open_members(path: str) -> NDArray[Any]:
    return open_npy(path, "rows from progdf region … -o FILE.npy")


def _check_file(text: str) -> None:
    if not text:
        raise ProgdfError("file: needs a file; write file:MEMBERS.npy, with a file from progdf region … -o")
    _open_members(text)


def _file(text: str, scene: Gaussians) -> Region:
    _check_file(text)
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[read_members(text, len(scene))] = True
    return from_mask(f"file:{text}", mask)


def _open_labels(path: str) -> NDArray[Any]:
    labels = open_npy(path, "labels, which are integers")
    if labels.dtype.kind not in "iub":
        raise ProgdfError(f"{path} holds {labels.dtype} numbers; expected integer labels")
    return labels


def _check_labels(text: str) -> None:
    _open_labels(_parse_labels(text)[0])


def _parse_labels(text: str) -> tuple[str, list[int]]:
    """Return the file and the labels of FILE.npy:ID[,ID…]."""
    path, colon, ids = text.rpartition(":")
    if not colon or not path:
        raise ProgdfError(f"region 'labels:{shorten(text)}' has no label; write labels:FILE.npy:ID[,ID…]")
    try:
        return path, [int(word) for word in ids.split(",")]
    except ValueError:
        raise ProgdfError(
            f"'{shorten(ids)}' in region 'labels:{shorten(text)}' is not a list of integers; "
            "write labels:FILE.npy:ID[,ID…]"
        ) from None


def _labels(text: str, scene: Gaussians) -> Region:
    path, ids = _parse_labels(text)
    labels = read_labels(path, len(scene))
    present = torch.unique(labels).tolist()
    present_labels = set(present)
    absent = [wanted_id for wanted_id in ids if wanted_id not in present_labels]
    if absent:
        listed = ", ".join(str(label) for label in present[:12]) + (" …" if len(present) > 12 else "")
        raise ProgdfError(f"{path} has no Gaussian with label {absent[0]}; it has {listed}")
    return from_labels(f"labels:{text}", labels, ids)


def _corners(text: str) -> list[float]:
    return _numbers("box", text, "x0,y0,z0,x1,y1,z1")


def _box(text: str, scene: Gaussians) -> Region:
    numbers = torch.tensor(_corners(text), dtype=torch.float64)
    return inside_box(f"box:{text}", scene, numbers[:3], numbers[3:])


def _ball(text: str) -> list[float]:
    numbers = _numbers("sphere", text, "x,y,z,r")
    if numbers[3] <= 0:
        raise ProgdfError(f"the radius in region 'sphere:{text}' is {numbers[3]:g}; it must be positive")
    return numbers


def _sphere(text: str, scene: Gaussians) -> Region:
    numbers = _ball(text)
    return inside_sphere(f"sphere:{text}", scene, torch.tensor(numbers[:3], dtype=torch.float64), numbers[3])


def _numbers(kind: str, text: str, form: str) -> list[float]:
    numbers = read_numbers(text)
    count = form.count(",") + 1
    if len(numbers) != count:
        raise ProgdfError(
            f"region '{kind}:{shorten(text)}' is not {count} numbers up to {MAX_NUMBER:g}; "
            f"write {kind}:{form}"
        )
    return numbers


def _extent(scene: Gaussians) -> str:
    low, high = (torch.tensor(scene.origin, dtype=torch.float64) + end for end in scene.means.aminmax(dim=0))
    ends = [
        (axis, *(format_place(at, b - a, 3) for at in (a, b)))
        for axis, a, b in zip("xyz", low.tolist(), high.tolist(), strict=True)
    ]
    return ", ".join(f"{axis} {a} to {b}" for axis, a, b in ends)
