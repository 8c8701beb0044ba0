"""The benchmark `recolors`: materials of all brightnesses recolored to six colors, judged in OKLab.

Each material is rendered as a lit ball with diffuse light, texture and highlights. Recolor, tint and a grade
of its typical color are applied by the functions of training and previews. Every ball should get the hue and
chroma of the chosen color in the median, keep its shading, and have no pixel of another hue. `--scenes` adds
regions of scenes. `--plots` draws all balls as one picture.

    python -m benchmarks recolors --plots assets
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from benchmarks.table import Table
from progdf.color import edits as color
from progdf.color import grade as grading
from progdf.color.oklab import srgb_from_linear, srgb_to_oklab
from progdf.color.shading import JND
from progdf.formats.scene_file import load_scene
from progdf.io.images import contact_sheet, to_picture
from progdf.region import from_mask, whole_scene
from trainer.options import TrainingViewOptions
from trainer.views.setup import render_thumbnails

MIN_CORRELATION = 0.95
"""Smallest acceptable correlation of the lightness before and after an edit."""
TARGETS = {
    "orange": "#e07b1a",
    "deep blue": "#1c3fa8",
    "pastel pink": "#f4b8c8",
    "black": "#000000",
    "white": "#ffffff",
    "green": "#2f8f3a",
}
"""Chosen colors, sRGB."""

SIDE_PX = 96
"""Side of a ball's picture."""

EDITS = ("recolor", "tint", "grade")
"""Judged edits; the grade changes the region's typical color."""
NOTE = (
    "Color error / correlation. Error: distance in OKLab's a and b of the median from the chosen color "
    f"(of a tint: 70 % of the way to it), at most {JND:g}, a just noticeable difference. Correlation of the "
    f"lightness before and after, outside highlights, at least {MIN_CORRELATION:g}. Off hue: share of pixels "
    "with another hue than the chosen one."
)

_PAGE = 0.5  # value of the sheet's background
_REGION_SHARE = 0.9  # smallest share of the region in a judged pixel
_LIGHT = (-0.45, -0.6, 0.66)  # direction to the light; x right, y down, z to the camera
_AMBIENT = 0.35  # share of diffuse light without a direction
_HIGHLIGHT = 0.01  # linear light from which a pixel has a highlight
_TINT_SHARE = 0.7  # share of a tint's color, see `tint_fully`


@dataclass(frozen=True)
class Material:
    """Surface of a ball, in linear light."""

    albedo: tuple[float, float, float]
    texture: float  # standard deviation of the albedo's texture, as a share
    grain_px: float  # sigma of the texture's blur, pixels
    gloss: float = 0.0  # linear light of the highlight, 1 is white
    sharpness: float = 40.0  # exponent of the highlight
    mirror: float = 0.0  # share of reflected surroundings, 0 to 1


MATERIALS = {
    "white paint": Material((0.86, 0.86, 0.85), 0.01, 2.0, gloss=0.25),
    "overexposed shirt": Material((1.05, 1.05, 1.05), 0.08, 4.0),
    "paper": Material((0.80, 0.79, 0.74), 0.02, 1.0),
    "white fur": Material((0.72, 0.70, 0.66), 0.22, 0.7),
    "chrome": Material((0.05, 0.05, 0.055), 0.0, 1.0, gloss=1.2, sharpness=120.0, mirror=0.75),
    "gray stone": Material((0.26, 0.25, 0.24), 0.30, 1.5),
    "beige wall": Material((0.66, 0.56, 0.42), 0.05, 1.5),
    "black cloth": Material((0.016, 0.016, 0.018), 0.30, 0.8),
    "black lacquer": Material((0.012, 0.011, 0.011), 0.02, 2.0, gloss=0.9, sharpness=60.0),
    "saturated red": Material((0.55, 0.02, 0.02), 0.05, 1.5, gloss=0.35),
}
"""Materials by name."""


@dataclass(frozen=True)
class Verdict:
    """Figures of one recolored region."""

    color_error: float  # OKLab distance of the median a and b from the chosen color's
    correlation: float  # of the lightness before and after
    off_hue: float  # share of the region's pixels with a hue that is not the chosen color's, 0 to 1

    @property
    def is_good(self) -> bool:
        """True if the figures are within the limits of this page."""
        return self.color_error <= JND and self.correlation >= MIN_CORRELATION and self.off_hue == 0.0


def ball(material: Material, side: int = SIDE_PX) -> tuple[Tensor, Tensor, Tensor]:
    """Render a lit ball.

    Args:
        material: surface of the ball
        side: side of the picture, pixels

    Returns:
        The picture, sRGB 0 to 1 [H,W,3]; the ball's pixels, and those without a highlight [H,W] bool each.
    """
    axis = (np.arange(side) + 0.5) / side * 2.2 - 1.1
    x, y = np.meshgrid(axis, axis)
    radius = np.hypot(x, y)
    inside = radius < 1.0
    normal = np.stack([x, y, np.sqrt(np.maximum(1.0 - radius**2, 0.0))], axis=-1)
    light = np.array(_LIGHT) / np.linalg.norm(_LIGHT)
    half = light + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    direct = np.maximum(normal @ light, 0.0)
    grain = gaussian_filter(np.random.default_rng(3).standard_normal((side, side)), material.grain_px)
    texture = np.maximum(1.0 + material.texture * grain / max(float(grain.std()), 1e-9), 0.1)
    diffuse = (_AMBIENT + (1.0 - _AMBIENT) * direct) * texture
    horizon = 0.5 + 0.5 * np.tanh(6.0 * (-2.0 * normal[..., 2] * normal[..., 1] - 0.1))
    surroundings = 0.12 + 0.8 * horizon
    highlight = material.gloss * np.maximum(normal @ half, 0.0) ** material.sharpness
    linear = diffuse[..., None] * np.array(material.albedo)
    linear = linear + (material.mirror * surroundings + highlight)[..., None]
    picture = srgb_from_linear(torch.from_numpy(linear.clip(0.0, 1.0)).float())
    ball_pixels = torch.from_numpy(inside)
    return picture, ball_pixels, ball_pixels & torch.from_numpy(highlight < _HIGHLIGHT)


def edits_of(rgb: Tensor, target: Tensor) -> Mapping[str, Tensor]:
    """Return a region's colors after each of `EDITS` at full strength. [N,3], [3] -> [N,3] each"""
    source = color.measure_color(rgb)
    grade = grading.ColorGrade(palette=((source.color, target),))
    grade = grading.measure_grade(grade, rgb, torch.ones(len(rgb)))
    return {
        "recolor": color.recolor_fully(rgb, target, source),
        "tint": color.tint_fully(rgb, target, source),
        "grade": grading.grade_fully(rgb, grade),
    }


def expected_ab(rgb: Tensor, target: Tensor, edit: str) -> Tensor:
    """Return OKLab's a and b of a region's expected median color after an edit, and of the target. [2,2]"""
    goal = srgb_to_oklab(target)[1:]
    own = srgb_to_oklab(rgb)[:, 1:].median(dim=0).values
    expected = torch.lerp(own, goal, _TINT_SHARE) if edit == "tint" else goal
    return torch.stack([expected, goal])


def judge(before: Tensor, after: Tensor, goals: Tensor, diffuse: Tensor) -> Verdict:
    """Judge a recolored region.

    A pixel has the right hue if it is within a just noticeable difference of a color with a hue between those
    of the goals, or of gray.

    Args:
        before: original colors of the region, sRGB. [N,3]
        after: edited colors, sRGB. [N,3]
        goals: OKLab's a and b of the expected median, and of the chosen color. [2,2]
        diffuse: True for pixels without a highlight, of which the shading is compared. [N] bool
    """
    old = srgb_to_oklab(before)
    new = srgb_to_oklab(after)
    middle = new[:, 1:].median(dim=0).values
    correlation = torch.corrcoef(torch.stack([old[diffuse, 0], new[diffuse, 0]]))[0, 1]
    chroma = goals.norm(dim=1, keepdim=True)
    rays = torch.where(chroma < JND, 0.0, goals / chroma.clamp_min(1e-6))
    between = torch.lerp(rays[:1], rays[1:], torch.linspace(0, 1, 33)[:, None])
    between = between / between.norm(dim=1, keepdim=True).clamp_min(1e-6)
    along = (new[:, 1:] @ between.T).clamp_min(0.0)
    aside = (new[:, None, 1:] - along[..., None] * between).norm(dim=2).amin(dim=1)
    off_hue = float((aside > JND).float().mean())
    return Verdict(float((middle - goals[0]).norm()), float(correlation.nan_to_num()), off_hue)


def regions(scenes: Sequence[Path] = ()) -> dict[str, tuple[Tensor, Tensor]]:
    """Return colors [N,3] and pixels without a highlight [N] of all materials, and of regions of the scenes.

    The region of a scene is label 1 of SCENE_labels.npy beside it, or the whole scene.
    """
    found = {}
    for name, material in MATERIALS.items():
        picture, inside, diffuse = ball(material)
        found[name] = picture[inside], diffuse[inside]
    for path in scenes:
        scene = load_scene(path)
        labels = path.with_name(f"{path.stem}_labels.npy")
        region = whole_scene(scene)
        if labels.is_file():
            region = from_mask(path.stem, torch.from_numpy(np.load(labels)) == 1)
        samples = render_thumbnails(TrainingViewOptions(scene=path), scene, region)
        rgb = torch.cat([sample.inside[sample.mask > _REGION_SHARE] for sample in samples])
        highlight = color.measure_color(rgb).shading.highlight
        found[path.stem] = rgb, srgb_to_oklab(rgb)[:, 0] <= highlight
    return found


def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Return the table of sources by targets, and draw the sheet of materials beside `plot` as .jpg."""
    if plot is not None:
        to_picture(sheet()).save(plot.with_suffix(".jpg"), quality=88)
    rows = []
    good = 0
    for name, (rgb, diffuse) in regions(scenes).items():
        for edit in EDITS:
            cells = {"source": name, "edit": edit}
            off_hue = 0.0
            for target_name, text in TARGETS.items():
                target = color.parse_color(text)
                after = edits_of(rgb, target)[edit]
                verdict = judge(rgb, after, expected_ab(rgb, target, edit), diffuse)
                good += verdict.is_good
                off_hue = max(off_hue, verdict.off_hue)
                cells[f"{target_name} {text}"] = f"{verdict.color_error:.3f} / {verdict.correlation:.2f}"
            cells["off hue, %"] = f"{100 * off_hue:.1f}"
            rows.append(cells)
    note = f"{NOTE} {good} of {len(rows) * len(TARGETS)} are within the limits."
    return [Table.of("recolors", "Sources of all brightnesses in six colors", rows, note)]


def sheet(edit: str = "recolor") -> Tensor:
    """Return a picture of all balls: a row per material, the original first. [H,W,3]"""
    rows = []
    for material in MATERIALS.values():
        picture, inside, _ = ball(material)
        cells = [torch.where(inside[..., None], picture, _PAGE)]
        for text in TARGETS.values():
            cell = torch.full_like(picture, _PAGE)
            cell[inside] = edits_of(picture[inside], color.parse_color(text))[edit]
            cells.append(cell)
        rows.append(cells)
    return contact_sheet(rows, list(MATERIALS), ["original", *TARGETS])
