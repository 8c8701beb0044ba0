"""The picture of `benchmarks.field`: worst error against bytes and milliseconds, an edit a column."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from PIL import Image, ImageDraw, ImageFont

from .field_forms import Form

PAPER, INK, PALE, GRID = (250, 249, 246), (38, 36, 34), (118, 113, 107), (228, 225, 219)

STYLES: dict[str, tuple[tuple[int, int, int], str]] = {
    "separable": ((34, 84, 180), "disc"),
    "joint SVD": ((150, 70, 160), "diamond"),
    "keyframes, int8": ((214, 96, 36), "square"),
    "keyframes, float32": ((150, 140, 130), "ring"),
    "auto": (INK, "star"),
}
"""Color and marker of each kind, in the order of the legend; the later lies above."""

COLUMNS, PANEL = 3, (328, 212)
LOW, HIGH = 10.0, 70.0
"""Decibels that the axis shows; what lies beyond is drawn on its edge."""

_ZOOM = 2  # drawn at twice the size and scaled down, for smooth edges
_LEFT, _RIGHT, _TOP, _BOTTOM = 38, 10, 12, 40
_HEAD, _TITLE = 40, 28

_Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


@dataclass(frozen=True)
class _Axis:
    """A logarithmic axis, from one power of ten's 1, 2 or 5 to another's."""

    name: str
    low: float
    high: float

    @staticmethod
    def around(name: str, values: Sequence[float]) -> _Axis:
        """Just wide enough for these values, all > 0."""
        return _Axis(name, min(values) / 1.25, max(values) * 1.25)

    def place(self, value: float) -> float:
        """0 at the low end, 1 at the high one."""
        return math.log(value / self.low) / math.log(self.high / self.low)

    def ticks(self) -> list[float]:
        """1, 2 and 5 of every decade within, or the 1 alone where there are many."""
        powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        steps = (1, 2, 5) if math.log10(self.high / self.low) < 2.2 else (1,)
        marks = [step * 10.0**power for power in powers for step in steps]
        return [mark for mark in marks if self.low <= mark <= self.high]


def draw_forms(forms: Sequence[Form]) -> Image.Image:
    """Small multiples: for each edit a panel over bytes a member and, below it, one over ms a slider step."""
    edits = list(dict.fromkeys(form.edit for form in forms))
    groups = -(-len(edits) // COLUMNS)
    width = COLUMNS * PANEL[0] + 12
    height = _HEAD + groups * (_TITLE + 2 * PANEL[1]) + 4
    page = Image.new("RGB", (width * _ZOOM, height * _ZOOM), PAPER)
    draw = ImageDraw.Draw(page)
    font, small = ImageFont.load_default(size=14 * _ZOOM), ImageFont.load_default(size=12 * _ZOOM)
    _legend(draw, [kind for kind in STYLES if any(f.kind == kind for f in forms)], small)
    # one scale for all edits, so that panels can be compared
    scales = (
        _Axis.around("bytes a member", [form.bytes_per_member for form in forms]),
        _Axis.around("ms a slider step", [min(form.step) for form in forms]),
    )
    for i, edit in enumerate(edits):
        own = [form for form in forms if form.edit == edit]
        x, y = 6 + (i % COLUMNS) * PANEL[0], _HEAD + (i // COLUMNS) * (_TITLE + 2 * PANEL[1])
        draw.text(((x + _LEFT) * _ZOOM, (y + 14) * _ZOOM), edit, INK, font, anchor="lm")
        said = f"{own[0].members:,} members".replace(",", " ")
        draw.text(((x + PANEL[0] - _RIGHT) * _ZOOM, (y + 14) * _ZOOM), said, PALE, small, anchor="rm")
        for row, axis in enumerate(scales):
            places = [min(form.step) if row else form.bytes_per_member for form in own]
            corner = (x, y + _TITLE + row * PANEL[1])
            _panel(draw, corner, axis, own, places, small, joined=row == 0)
    return page.resize((width, height), Image.Resampling.LANCZOS)


def _panel(
    draw: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    axis: _Axis,
    forms: Sequence[Form],
    places: Sequence[float],
    font: _Font,
    joined: bool,
) -> None:
    left, top = (corner[0] + _LEFT) * _ZOOM, (corner[1] + _TOP) * _ZOOM
    right, bottom = (corner[0] + PANEL[0] - _RIGHT) * _ZOOM, (corner[1] + PANEL[1] - _BOTTOM) * _ZOOM

    def at_x(value: float) -> float:
        return left + axis.place(value) * (right - left)

    def at_y(decibels: float) -> float:
        return bottom - (min(max(decibels, LOW), HIGH) - LOW) / (HIGH - LOW) * (bottom - top)

    for level in range(int(LOW), int(HIGH) + 1, 10):
        draw.line([(left, at_y(level)), (right, at_y(level))], GRID, _ZOOM)
        draw.text((left - 6 * _ZOOM, at_y(level)), str(level), PALE, font, anchor="rm")
    for tick in axis.ticks():
        draw.line([(at_x(tick), bottom), (at_x(tick), bottom + 4 * _ZOOM)], PALE, _ZOOM)
        draw.text((at_x(tick), bottom + 12 * _ZOOM), f"{tick:g}", PALE, font, anchor="mm")
    name = f"worst PSNR, dB, over {axis.name}"
    draw.text(((left + right) / 2, bottom + 28 * _ZOOM), name, PALE, font, anchor="mm")
    points: dict[str, list[tuple[float, float]]] = {}
    for form, place in zip(forms, places, strict=True):
        points.setdefault(form.kind, []).append((at_x(place), at_y(form.worst)))
    for kind, (color, _) in STYLES.items():
        if joined and len(points.get(kind, [])) > 1:
            path: list[tuple[float, float]] = sorted(points[kind])
            draw.line(path, color, round(1.5 * _ZOOM))
    for kind in STYLES:
        for x, y in points.get(kind, []):
            _mark(draw, kind, x, y)


def _mark(draw: ImageDraw.ImageDraw, kind: str, x: float, y: float) -> None:
    color, shape = STYLES[kind]
    r, thin = 4.5 * _ZOOM, 2 * _ZOOM
    if shape == "disc":
        draw.ellipse([x - r, y - r, x + r, y + r], color)
    elif shape == "ring":
        draw.ellipse([x - r, y - r, x + r, y + r], PAPER, color, thin)
    elif shape == "square":
        draw.rectangle((x - 0.85 * r, y - 0.85 * r, x + 0.85 * r, y + 0.85 * r), color)
    elif shape == "diamond":
        draw.polygon([(x - r, y), (x, y - 1.2 * r), (x + r, y), (x, y + 1.2 * r)], color)
    elif shape == "triangle":
        draw.polygon([(x - r, y + 0.8 * r), (x, y - r), (x + r, y + 0.8 * r)], color)
    else:
        turns = [math.pi * (i / 5 - 0.5) for i in range(10)]
        sizes = [(1.7 if i % 2 == 0 else 0.7) * r for i in range(10)]
        star = [(x + s * math.cos(a), y + s * math.sin(a)) for s, a in zip(sizes, turns, strict=True)]
        draw.polygon(star, color, PAPER)


def _legend(draw: ImageDraw.ImageDraw, kinds: Sequence[str], font: _Font) -> None:
    """One row; all kinds there are fit into the width of three panels."""
    x, y = 16.0 * _ZOOM, 18.0 * _ZOOM
    for kind in kinds:
        name = "auto's choice, 40 dB" if kind == "auto" else kind
        _mark(draw, kind, x, y)
        draw.text((x + 11 * _ZOOM, y), name, INK, font, anchor="lm")
        x += draw.textlength(name, font) + 30 * _ZOOM
