"""Grade of the form, applied to the colors that a region shows in the current view.

Only the base color of each member changes, by the difference of its graded and its drawn color from the
camera. This is exact in the view on screen, for spherical harmonics of any degree. Layers below keep their
effect, because the drawn color includes them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.camera import Camera
from progdf.color.clarity import clarify, local_detail
from progdf.color.grade import ColorGrade, grade_course, grade_fully, measure_grade, parse_grade
from progdf.color.oklab import STRAIGHT, color_path
from progdf.errors import ProgdfError
from progdf.field.baked import lattice_colors
from progdf.field.grade import look_up
from progdf.formats.cube import read_cube
from progdf.gaussians import Gaussians
from progdf.sh import C0, basis
from progdf.threads import run_chunks
from viewer.jobs.preview_process import RegionSample
from viewer.state.forms import CUBE_LOOK, NewEdit
from viewer.state.transient import GradeScope

SIDE = 33
"""Points per edge of the lattice that grades many colors at once."""
BINS = 64
"""Bins of the histogram."""
_CHUNK_ROWS = 1 << 14  # rows that one thread shades at once
_SCOPE_COLORS = 4096  # largest number of sampled colors of the histogram


class GradeLattice:
    """Lattice of colors under the newest grade. Each point is graded once, whoever looks it up.

    A new grade is evaluated at once at all points that the last one was looked up at. In a drag, the picture
    and the histogram therefore share one evaluation per frame.
    """

    def __init__(self) -> None:
        self._live: LiveGrade | None = None
        self._colors = lattice_colors(SIDE).float()
        self._graded = self._colors.clone()
        self._known = torch.zeros(SIDE**3, dtype=torch.bool)

    def look_up(self, colors: Tensor, points: Tensor, live: LiveGrade) -> Tensor:
        """Return graded colors, interpolated between lattice points. [M,3] -> [M,3]

        Args:
            colors: sRGB colors, 0 to 1. [M,3]
            points: their lattice points, see `used_points`. [K] int64
            live: the grade
        """
        if self._live is None or not self._live.is_same_grade(live):
            due = self._known.clone()
            due[points] = True
            self._known.zero_()
            self._live = live
        else:
            due = torch.zeros_like(self._known)
            due[points] = True
            due &= ~self._known
        rows = due.nonzero()[:, 0]
        if len(rows):
            self._graded[rows] = _at_strength(self._colors[rows], live)
        self._known[points] = True
        return look_up(colors.T, self._graded).T


@dataclass(frozen=True)
class LiveGrade:
    """Grade of some Gaussians at a strength."""

    rows: NDArray[np.int64]  # ascending. [M]
    grade: ColorGrade  # with its measured palette
    strength: float = 1.0  # 0 to 1
    marks: bool = False  # show clipped colors: white in red, black in blue
    table: Tensor | None = None  # color table instead of the grade, see `look_up`. [side³,3]
    lattice: GradeLattice = field(default_factory=GradeLattice)  # shared by the grades of a form

    def is_same_grade(self, other: LiveGrade) -> bool:
        """Return True if another one changes every color alike."""
        return self.table is other.table and self.grade is other.grade and self.strength == other.strength

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, LiveGrade)
            and self.rows is other.rows
            and self.is_same_grade(other)
            and self.marks == other.marks
        )

    __hash__ = None  # type: ignore[assignment]


WHITE_MARK = (0.95, 0.1, 0.1)
"""Color of clipped white in the picture, sRGB."""
BLACK_MARK = (0.15, 0.35, 1.0)
"""Color of clipped black in the picture, sRGB."""


def clipped_colors(colors: Tensor) -> tuple[Tensor, Tensor]:
    """Return where colors are clipped: a channel at 255, or all channels at 0. [...,3] -> [...], [...]"""
    half_level = 0.5 / 255
    return colors.amax(dim=-1) > 1.0 - half_level, colors.amax(dim=-1) < half_level


class ColorTable:
    """Colors of members, and the points of a lattice around them, at which a grade is evaluated.

    Args:
        colors: drawn colors, of any value. [M,3]
        is_exact: grade each color by itself if there are fewer of them than points
    """

    def __init__(self, colors: Tensor, is_exact: bool = True) -> None:
        self.colors = colors
        self._inside = colors.clamp(0.0, 1.0)
        self._points: Tensor | None = None
        if len(colors) > SIDE**3 or not is_exact:
            points = used_points(self._inside)
            self._points = points if len(points) < len(colors) else None

    def apply(self, live: LiveGrade, detail: Tensor | None = None) -> Tensor:
        """Return the colors after the grade: exact for few, from the lattice for many. [M,3]

        Args:
            live: the grade
            detail: detail of the colors, for clarity; None for none. [M]
        """
        clarity = live.grade.clarity if detail is not None and live.table is None else 0.0
        if self._points is None:
            graded = _at_strength(self._inside, live, detail if clarity else None)
        else:
            inside = self._inside
            points = self._points
            if detail is not None and clarity:
                inside = clarify(inside, detail, clarity * live.strength)
                points = used_points(inside)
            graded = live.lattice.look_up(inside, points, live)
        if live.marks:
            white, black = clipped_colors(graded)
            graded = graded.clone()
            graded[white] = graded.new_tensor(WHITE_MARK)
            graded[black] = graded.new_tensor(BLACK_MARK)
        return graded


def _at_strength(colors: Tensor, live: LiveGrade, detail: Tensor | None = None) -> Tensor:
    """Return the colors at the strength of the grade. [...,3] -> [...,3]"""
    if live.table is not None:
        flat = colors.reshape(-1, 3)
        full = look_up(flat.T, live.table).T.reshape(colors.shape).clamp(0.0, 1.0)
        return color_path(colors, full, STRAIGHT)(live.strength)
    if live.strength == 1.0:
        return grade_fully(colors, live.grade, detail)
    return grade_course(colors, live.grade, detail)(live.strength)


def used_points(colors: Tensor) -> Tensor:
    """Return the lattice points that `look_up` reads for some colors. [M,3] -> [K] int64"""
    cells = (colors * (SIDE - 1)).floor().long().clamp(0, SIDE - 2)
    used = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)  # blue, green, red
    index = (cells[:, 2] * SIDE + cells[:, 1]) * SIDE + cells[:, 0]
    used.view(-1)[index] = True
    for axis in range(3):
        used |= used.roll(1, dims=axis)  # the last layer of cells is never used
    return used.view(-1).nonzero()[:, 0]


class LiveColors:
    """Base colors of a scene under a live grade. Values that consecutive frames share are kept."""

    def __init__(self) -> None:
        self._key: object = None
        self._table: ColorTable | None = None
        self._moving: ColorTable | None = None
        self._detail: tuple[object, NDArray[np.int64], NDArray[np.float32]] | None = None

    def detail(self, scene: Gaussians, live: LiveGrade, version: object) -> NDArray[np.float32] | None:
        """Return the detail of the grade's rows, measured once per region; None without clarity. [M]

        Args:
            scene: composed scene
            live: the grade
            version: changes whenever the colors of `scene` do
        """
        if not live.grade.clarity:
            return None
        kept = self._detail
        if kept is None or kept[0] != version or kept[1] is not live.rows:
            measured = local_detail(scene, torch.from_numpy(live.rows)).numpy()
            kept = self._detail = version, live.rows, measured
        return kept[2]

    def recolor(self, live: LiveGrade, colors: Tensor, detail: Tensor | None) -> Tensor:
        """Return the graded colors of a picture during motion. [P,3] -> [P,3]"""
        if self._moving is None or self._moving.colors is not colors:
            self._moving = ColorTable(colors, is_exact=False)
        return self._moving.apply(live, detail)

    def apply(self, scene: Gaussians, live: LiveGrade, camera: Camera, version: object) -> Gaussians:
        """Return the scene with graded base colors of the grade's rows.

        Args:
            scene: composed scene
            live: the grade
            camera: view in which the grade is exact
            version: changes whenever the colors of `scene` do
        """
        rows = torch.from_numpy(live.rows)
        position = camera.position
        key = (version, id(live.rows), tuple(position.tolist()) if scene.sh_degree else ())
        if self._table is None or self._key != key:
            self._table = ColorTable(drawn_colors(scene, rows, position))
            self._key = key
        before = self._table.colors
        detail = self.detail(scene, live, version)
        after = self._table.apply(live, None if detail is None else torch.from_numpy(detail))
        change = (after - before) / C0
        change[(after <= 0.0) & (before <= 0.0)] = 0.0
        sh0 = scene.sh0.clone()
        sh0[rows] += change.to(sh0)
        return replace(scene, sh0=sh0)


def drawn_colors(scene: Gaussians, rows: Tensor, position: Tensor) -> Tensor:
    """Return the colors of some rows from a position, below 0 where a lobe is black. [M,3]

    Args:
        scene: the scene
        rows: ascending. [M] int64
        position: of the camera, world units. [3]
    """
    degree = min(scene.sh_degree, 3)
    if not degree:
        return scene.sh0[rows].float() * C0 + 0.5
    colors = torch.empty(len(rows), 3)
    has_gaps = len(rows) > 0 and int(rows[-1] - rows[0]) >= len(rows)

    def shade(chunk: int) -> None:
        part = slice(chunk * _CHUNK_ROWS, (chunk + 1) * _CHUNK_ROWS)
        chosen = rows[part]
        # a slice is read in place
        where = chosen if has_gaps else slice(int(chosen[0]), int(chosen[-1]) + 1)
        directions = torch.nn.functional.normalize(scene.means[where].float() - position.float(), dim=1)
        weights = basis(degree, directions)[:, 1:]
        lobes = torch.bmm(weights[:, None], scene.shN[where, : weights.shape[1]].float())[:, 0]
        colors[part] = scene.sh0[where].float() * C0 + 0.5 + lobes

    run_chunks(shade, -(-len(rows) // _CHUNK_ROWS))
    return colors


class FormGrader:
    """Settings of the form as a `LiveGrade`. Measurements are kept until a source color changes."""

    def __init__(self) -> None:
        self.rows: NDArray[np.int64] | None = None
        """Rows of the form's region, ascending; None if they are not known yet. [M]"""
        self.sample: RegionSample | None = None
        """Sample of the region's colors; None if it is not known yet."""
        self._last: tuple[object, LiveGrade | None] | None = None
        self._measured: tuple[object, ColorGrade] | None = None
        self._lattice = GradeLattice()

    @property
    def is_empty(self) -> bool:
        """True if the form's region has no Gaussians."""
        return self.rows is not None and not len(self.rows)

    def live(self, form: NewEdit) -> LiveGrade | None:
        """Return the form's grade; None if it changes nothing."""
        if self.rows is None:
            return None
        spec = form.hovered_look or form.spec
        key = (spec, id(self.rows), id(self.sample))
        if self._last is None or self._last[0] != key:
            self._last = key, self._new(spec, self.rows)
        live = self._last[1]
        if live is None and form.clipping:
            live = LiveGrade(self.rows, ColorGrade(), lattice=self._lattice)
        if live is None or not (form.strength or form.clipping):
            return None
        return replace(live, strength=form.strength, marks=form.clipping)

    def scope(self, live: LiveGrade | None, is_moving: bool = False) -> GradeScope:
        """Return the histogram of the region's colors under a grade; empty before they are known.

        Args:
            live: the grade; None for none
            is_moving: interpolate the graded colors on the lattice of the picture in motion
        """
        sample = self.sample
        if self.is_empty:
            return GradeScope(note="The region is empty: select something")
        if sample is None or not len(sample.colors):
            return GradeScope()
        stride = -(-len(sample.colors) // _SCOPE_COLORS)
        colors = torch.from_numpy(sample.colors[::stride]).clamp(0.0, 1.0)
        if live is not None and is_moving:
            colors = live.lattice.look_up(colors, used_points(colors), live)
        elif live is not None:
            colors = _at_strength(colors, live)
        weights = torch.from_numpy(sample.shares[::stride]).double()
        luma = colors @ colors.new_tensor([0.2126, 0.7152, 0.0722])
        values = torch.cat([luma[:, None], colors], dim=1)
        bins = (values * BINS).long().clamp(0, BINS - 1)
        counts = torch.stack([torch.bincount(bins[:, i], weights, BINS) for i in range(4)])
        tallest = counts[:, 1:-1].max().clamp_min(1e-9)
        white, black = clipped_colors(colors)
        total = weights.sum().clamp_min(1e-9)
        return GradeScope(
            tuple(tuple(row) for row in (counts / tallest).clamp(0.0, 1.0).tolist()),
            float(weights[white].sum() / total),
            float(weights[black].sum() / total),
        )

    def thumbnail(self, look: str) -> NDArray[np.uint8] | None:
        """Return the small view under a look; None before the view is known. [H,W,3]"""
        sample = self.sample
        if sample is None or self.rows is None:
            return None
        live = self._new(look, self.rows)
        inside = torch.from_numpy(sample.inside).clamp(0.0, 1.0)
        change = torch.zeros_like(inside) if live is None else _at_strength(inside, live) - inside
        pixels = torch.from_numpy(sample.image) + torch.from_numpy(sample.mask)[..., None] * change
        thumbnail: NDArray[np.uint8] = (255.0 * pixels.clamp(0.0, 1.0)).round().byte().numpy()
        return thumbnail

    def _new(self, spec: str, rows: NDArray[np.int64]) -> LiveGrade | None:
        """Return the grade of a form's editor, or a color table; None if it changes nothing."""
        try:
            if spec.startswith(CUBE_LOOK):
                table = read_cube(spec.removeprefix(CUBE_LOOK))
                return LiveGrade(rows, ColorGrade(), table=table, lattice=self._lattice)
            grade = parse_grade(spec.partition(":")[2])
        except ProgdfError:
            return None
        sample = self.sample
        if grade.palette and sample is not None:
            sources = tuple(tuple(source.tolist()) for source, _ in grade.palette)
            key = (sources, id(sample))
            if self._measured is None or self._measured[0] != key:
                colors = torch.from_numpy(sample.colors)
                self._measured = key, measure_grade(grade, colors, torch.from_numpy(sample.shares))
            shadings = self._measured[1].palette_shadings
            shades = self._measured[1].palette_shades
            grade = replace(grade, palette_shadings=shadings, palette_shades=shades)
        return LiveGrade(rows, grade, lattice=self._lattice)
