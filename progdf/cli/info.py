"""The command `progdf info FILE`: show the contents of a scene, an edit, a session or cameras."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from progdf.errors import ProgdfError
from progdf.field.baked import BakedField, GradeForm
from progdf.formats.containers import check_foreign
from progdf.formats.cube import SUFFIX as CUBE
from progdf.formats.ply_view import stored_view
from progdf.formats.scene_file import load_scene_with_report, scene_file, scene_format
from progdf.gaussians import ZERO, Gaussians
from progdf.gdf.file import read_gdf
from progdf.io import session as session_file
from progdf.io.atomic import read_file
from progdf.io.cameras import holds_cameras, load_cameras_with_report
from progdf.scene import UpChoice
from progdf.scene.bounds import is_surrounding, scene_sphere
from progdf.scene.scene_cameras import SceneCameras, load_scene_cameras
from progdf.scene.strays import find_strays
from progdf.scene.up_axis import UpAxis, find_up
from progdf.terminal import (
    file_size,
    format_count,
    format_place,
    group_digits,
    notice_when_slow,
    print_line,
)

from .options import absent_option, parse_options

_UTF8_BOM = b"\xef\xbb\xbf"  # start of UTF-8 text from some Windows programs


@dataclass(frozen=True)
class Survey:
    """Measurements of a scene."""

    count: int  # number of Gaussians N
    center: tuple[float, float, float]  # median of the means, in the world
    radius: float  # distance from the center within which 97 % of the means lie, world units
    farthest: float  # distance of the farthest mean from the center, world units
    # box, bulk_box: the corners of all Gaussians, and of the middle 95 % along each axis, in the world
    box: tuple[float, ...]
    bulk_box: tuple[float, ...]
    up: UpAxis  # up axis, and the reason for it
    surrounding: bool  # the scene seems to surround the viewer, so cameras around it cannot frame it
    median_size: float  # median of the longest axes, one standard deviation, world units
    largest_size: float  # longest axis of all Gaussians, one standard deviation, world units

    def lines(self) -> list[str]:
        """Return the survey for the user, one line per fact."""
        center = " ".join(format_place(at, self.radius, 4) for at in self.center)
        lines = [
            f"position: center {center}, radius {self.radius:.4g} (97 % of the Gaussians), "
            f"farthest {self.farthest:.4g}",
            f"up: {self.up.name}, {self.up.reason}",
            f"bulk, 95 % along each axis: --region {_box(self.bulk_box)}",
            f"all: --region {_box(self.box)}",
            f"size: median {self.median_size:.3g}, largest {self.largest_size:.3g} "
            "(longest axis, one standard deviation)",
        ]
        if self.surrounding:
            lines.append(
                "cameras: the scene surrounds the viewer, so cameras around it cannot frame it; training "
                "puts some at free places around a region; the scene's own (--cameras) are better"
            )
        return lines


def survey(scene: Gaussians, up: UpAxis | None = None) -> Survey:
    """Measure a scene of at least one Gaussian with finite numbers, as returned by `load_ply`.

    Args:
        scene: N Gaussians
        up: up axis; None to estimate it
    """
    center, radius = scene_sphere(scene)
    up = find_up(scene) if up is None else up
    longest = scene.log_scales.amax(dim=1).exp()
    x, y, z = (at + middle for at, middle in zip(scene.origin, center.tolist(), strict=True))
    return Survey(
        count=len(scene),
        center=(x, y, z),
        radius=radius,
        farthest=float((scene.means - center).norm(dim=1).max()),
        box=_corners(scene, 0.0),
        bulk_box=_corners(scene, 0.025),
        up=up,
        surrounding=is_surrounding(scene, up.direction),
        median_size=float(longest.median()),
        largest_size=float(longest.max()),
    )


def _corners(scene: Gaussians, left_out: float) -> tuple[float, ...]:
    """Return the smallest and largest x, y, z of the means in the world, as six numbers.

    Args:
        scene: N Gaussians
        left_out: share of the means to ignore at each end of an axis, 0 to 0.5
    """
    means = scene.means.numpy()
    first = int(left_out * len(means))
    last = len(means) - 1 - first
    columns = [np.partition(column, (first, last)) for column in means.T]
    extremes = [float(column[row]) for row in (first, last) for column in columns]
    return tuple(at + end for at, end in zip(2 * scene.origin, extremes, strict=True))


def _box(corners: tuple[float, ...]) -> str:
    """Return the corners as a region, rounded outwards to five significant digits of the box's diagonal."""
    step = 10.0 ** math.floor(math.log10(max(math.dist(corners[:3], corners[3:]), 1e-12)) - 4)
    decimals = max(0, -round(math.log10(step)))
    rounded = [(math.floor, math.ceil)[i // 3](corner / step) * step for i, corner in enumerate(corners)]
    return "box:" + ",".join(f"{corner:.{decimals}f}" for corner in rounded)


@dataclass(frozen=True)
class InfoOptions:
    """Show the contents of a scene, a .gdf edit, a session or cameras. Nothing is written.

    For a scene, this includes its repairs and strays; for an edit, its error report; for cameras, the ignored
    fields.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """File to describe; its type is recognized by content, not by name."""
    cameras: Annotated[Path | None, absent_option("CAMERAS", "those beside the file")] = None
    """Cameras of the scene, used to find the up axis."""
    up: UpChoice = "auto"
    """Up axis of the scene."""


def main(argv: Sequence[str]) -> int:
    """Print the contents of a file.

    Raises:
        ProgdfError: the file type is unknown, or the file cannot be loaded.
    """
    options = parse_options(InfoOptions, argv, "progdf info")
    for line in describe(options.file, options.cameras, options.up):
        print_line(line)
    return 0


def describe(path: Path, cameras: Path | None = None, up: UpChoice = "auto") -> Iterable[str]:
    """Return the contents of a file, line by line.

    Args:
        path: a file of any type in `kind_of`
        cameras: cameras of a scene; None for those beside it
        up: up axis of a scene

    Raises:
        ProgdfError: the file cannot be loaded, or `cameras` or `up` is given for a file that is not a scene.
    """
    kind = kind_of(path)
    if kind == "scene":
        return _scene_lines(path, cameras, up)
    if cameras is not None or up != "auto":
        raise ProgdfError(f"{path} is not a scene; leave --cameras and --up out")
    return _LINES_BY_KIND[kind](path)


def kind_of(path: str | os.PathLike[str]) -> str:
    """Return "scene", "gdf", "session" or "cameras", by content, otherwise by name.

    Raises:
        ProgdfError: the file cannot be read, or has an unknown type.
    """
    path = scene_file(path)
    if holds_cameras(path):
        return "cameras"
    start = read_file(path, 64).removeprefix(_UTF8_BOM)
    if start[8:9] == b"{" and int.from_bytes(start[:8], "little") < 1 << 32:
        return "gdf"
    if scene_format(path) is not None:
        return "scene"
    if session_file.is_session(start):
        return "session"
    if start.lstrip()[:1] in (b"{", b"[") or start.startswith(b"\x89PNG"):
        return "cameras"
    if path.suffix.lower() in (".gdf", CUBE):
        return "gdf"  # its reader raises the most specific error
    check_foreign(path, start)
    raise ProgdfError(f"{path} has an unknown file type; give a scene, a .gdf edit or a camera file")


def _scene_lines(path: Path, cameras: Path | None, up: UpChoice) -> Iterator[str]:
    """Describe a scene: its repairs, size, position and strays."""
    scene, report = load_scene_with_report(path)
    found = SceneCameras([])
    if cameras is not None:
        found = load_scene_cameras(cameras, scene, path, anyway=True)
    yield from report.lines()
    yield from found.notes
    yield from survey(scene, find_up(scene, found.cameras, up, path)).lines()
    camera = stored_view(path, scene.origin).camera
    if camera is not None:
        yield f"camera: {camera.width}x{camera.height} pixels, stored in the file; it is the first view"
    with notice_when_slow(f"looking for strays among {format_count(len(scene))} …"):
        strays = find_strays(scene)
    if len(strays.rows):
        clean = f"progdf edit {shlex.quote(str(path))} --clean -o CLEAN.ply leaves them out"
        yield f"strays: {strays.describe()}; {clean}"


def _edit_lines(path: Path) -> Iterator[str]:
    gdf = read_gdf(path)
    size = path.stat().st_size
    members = gdf.members
    count = gdf.scene.count
    yield f"{path.name}: the edit '{gdf.name}', {file_size(size)}"
    if gdf.instruction:
        yield f"instruction: {gdf.instruction}"
    sizes = ""
    if count:
        yield f"scene: {format_count(count)}, fingerprint {gdf.scene.means_sha256[:12]}"
        region = len(gdf.region)
        added = members - len(gdf.region)
        yield f"region: {gdf.region.name}, {format_count(region)} ({region / max(1, count):.1%})"
        if added:
            yield f"adds: {format_count(added)}, all invisible at strength 0"
        each = gdf.field.bytes_per_member
        sizes = f"{each:.4g} bytes per Gaussian, {size / max(1, members):.4g} with the header, "
    yield f"field: {gdf.field.kind}, {sizes}{_describe_field(gdf.field)}"
    if gdf.field.kind == "grade":
        bound = "bound to its scene; its map alone" if count else "bound to no scene; it"
        yield f"grade: {bound} can be applied to any scene with --region {gdf.name}=REGION"
    if gdf.field.recorded:
        yield f"recorded: {len(gdf.field.recorded)} snapshots"
    for head, content in (("option", gdf.options), ("report", gdf.report)):
        given = {name: value for name, value in content.items() if head == "report" or value is not None}
        for name, value in _flatten(given):
            yield f"{head}: {name} {value}"


def _session_lines(path: Path) -> Iterator[str]:
    session = session_file.read_session(path, session_file.SessionFile)
    yield f"{path.name}: a session of the window, {file_size(path.stat().st_size)}"
    scenes = (session.scene, *session.added)
    references = [*(("scene", scene) for scene in scenes), *(("edit", edit) for edit in session.edits)]
    for kind, ref in references:
        file = ref.path(path.resolve().parent)
        if not os.path.isfile(file):
            state = "missing"
        elif session_file.sha256(file) == ref.sha256.lower():
            state = "unchanged"
        else:
            state = "changed"
        yield f"{kind}: {ref.file} ({state})"
    layers = session.view.get("layers", [])
    for layer in layers if isinstance(layers, list) else ():
        if isinstance(layer, dict):
            hidden = "" if layer.get("enabled", True) else ", hidden"
            strength = _short_text(layer.get("strength", 0.0))
            yield f"layer: {_short_text(layer.get('name'))} at {strength}{hidden}"
    yield f"snapshots: {len(session.snapshots)}"


def _describe_field(field: BakedField) -> str:
    """Return a description of the parts of a field."""
    form = field.origin
    if isinstance(form, GradeForm):
        return f"{form.label}; {len(form.knots)} knots"
    if form is None:
        stored = ", ".join(f"{name} {bases.label}" for name, bases in field.attributes.items())
        return f"{len(field.knots)} knots; full edits and bases: {stored or 'none, no offsets'}"
    network = form.network
    error = ", ".join(f"{name} {value:.4g}" for name, value in (form.error or {}).items())
    bases = ", ".join(f"{name} {rank}" for name, rank in form.plan.ranks.items())
    return (
        f"{group_digits(network.parameters)} numbers in {network.shape.layers} layers of "
        f"{network.shape.width}; baked at {len(form.plan.knots)} knots with bases: {bases}; "
        f"baking error: {error}"
    )


def _camera_lines(path: Path) -> Iterator[str]:
    cameras, report = load_cameras_with_report(path, ZERO)
    yield f"{path.resolve().name}: {format_count(len(cameras), 'camera')}"
    yield from report.notes
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    more = f" and {len(sizes) - 4} other sizes" if len(sizes) > 4 else ""
    yield "images: " + ", ".join(f"{width}x{height}" for width, height in sizes[:4]) + more + " pixels"
    distorted_count = sum(camera.lens is not None for camera in cameras)
    if distorted_count:
        yield f"lens: {distorted_count} of {len(cameras)} cameras have one; photographs are undistorted"
    if report.ignored:
        yield f"ignored: {', '.join(map(_short_text, report.ignored))}"


_LINES_BY_KIND = {
    "gdf": _edit_lines,
    "session": _session_lines,
    "cameras": _camera_lines,
}


def _flatten(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Yield dotted names and values of a nested JSON table, such as ("field.psnr_worst", "46.9").

    A list of more than 8 values is given by its length.
    """
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{above}{name}.")
        elif isinstance(value, list) and len(value) > 8:
            yield f"{above}{name}", f"{group_digits(len(value))} values"
        else:
            yield f"{above}{name}", _short_text(value)


def _short_text(value: object) -> str:
    if value is None:
        return "not measured"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(_short_text(entry) for entry in value) or "none"
    return " ".join(str(value).split())
