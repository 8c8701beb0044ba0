"""From parts and paint to a scene: how many Gaussians where, which show, how they lie, how they are lit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.color.edits import parse_color
from progdf.color.oklab import linear_from_srgb, smoothstep
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, concatenate
from progdf.quaternions import matrix_quats
from progdf.sh import rgb_to_sh0
from progdf.threads import one_thread

from .light import OUTDOORS, Daylight, develop, irradiance, view_dependent_light
from .surface import Part, Samples, sample

_SIDE = 64  # the lattice repeats after this many cells; a power of two


def lattice(seed: int) -> Tensor:
    """Random numbers in −1..1 on a lattice of 64³ nodes, for `noise`. [64³] float32"""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(_SIDE**3, generator=generator) * 2 - 1


def noise(points: Tensor, table: Tensor, frequency: float, octaves: int = 1) -> Tensor:
    """Value noise, −1..1, mean about 0; each octave doubles the frequency and halves the height.

    Args:
        points: where. [N,3]
        table: what `lattice` made
        frequency: cells per world unit
        octaves: how many layers of detail, ≥ 1

    Returns:
        [N]
    """
    total = torch.zeros(points.shape[0])
    height = 1.0
    span = 0.0
    for octave in range(octaves):
        # the shift keeps the lattice planes of the octaves, and the part's planes of symmetry, apart
        total += height * _value_noise(points * frequency + 17.31 * (octave + 1), table)
        span += height
        height = height / 2
        frequency = frequency * 2
    return total / span


def _value_noise(places: Tensor, table: Tensor) -> Tensor:
    cell = places.floor()
    f = smoothstep(places - cell)
    low = cell.long() & (_SIDE - 1)
    high = (low + 1) & (_SIDE - 1)
    x = (low[:, 0] * _SIDE * _SIDE, high[:, 0] * _SIDE * _SIDE)
    y = (low[:, 1] * _SIDE, high[:, 1] * _SIDE)
    z = (low[:, 2], high[:, 2])
    planes = []
    for i in range(2):
        rows = [torch.lerp(table[x[i] + y[j] + z[0]], table[x[i] + y[j] + z[1]], f[:, 2]) for j in range(2)]
        planes.append(torch.lerp(rows[0], rows[1], f[:, 1]))
    return torch.lerp(planes[0], planes[1], f[:, 0])


@dataclass(frozen=True)
class Pelt:
    """How the Gaussians of a surface lie: most of them flat on it, some standing out as hairs or blades."""

    standing: float = 0.0  # share of those that stand out, 0..1
    # standard deviations along the flow, across it and through the surface, in sample spacings
    flat: tuple[float, float, float] = (0.64, 0.64, 0.14)
    hair: tuple[float, float, float] = (0.70, 0.24, 0.16)  # the same of those that stand out
    # what is added to a hair's first, world units: fur keeps some length however fine the sampling
    length: float = 0.0
    rise: float = 0.45  # how steeply a hair leaves the surface; 0 lies, 1 is 45 degrees
    lift: float = 0.35  # how far a hair's middle is above the surface, in its first standard deviation
    unruly: float = 0.35  # how much directions differ from neighbor to neighbor


BARE = Pelt()


@dataclass(frozen=True)
class SurfacePaint:
    """What a surface looks like before light falls on it."""

    color: Tensor  # sRGB 0..1. [N,3]
    relief: Tensor  # how far the normals lean, for light only. [N,3]
    velvet: float = 0.0  # brightening where the surface turns away from the eye, sRGB units
    gloss: float = 0.0  # mirror highlight, sRGB units
    # where hairs and flat Gaussians point; only its part along the surface counts. [N,3]
    flow: Tensor | None = None
    pelt: Pelt = BARE  # how the Gaussians lie
    glows: bool = False  # whether `color` is what is seen, whatever light there is


Painter = Callable[[Part, Samples, Tensor], SurfacePaint]
"""The paint of a part at its samples; the tensor is the noise's table."""


def bumps(points: Tensor, table: Tensor, frequency: float, height: float) -> Tensor:
    """A relief of noise, see `SurfacePaint.relief`. [N,3] -> [N,3]"""
    offsets = torch.tensor([[0.0, 0.0, 0.0], [5.2, 1.3, 8.1], [2.7, 9.4, 4.6]])
    return height * torch.stack([noise(points + offset, table, frequency, 2) for offset in offsets], dim=1)


def swirl(points: Tensor, table: Tensor, main: tuple[float, float, float], height: float = 0.7) -> Tensor:
    """A flow along `main` that noise bends. [N,3] -> [N,3]"""
    bend = torch.stack([noise(points + 3.1 * k, table, 2.5) for k in range(3)], dim=1)
    return torch.tensor(main) + height * bend


def mix_colors(dark: str, light: str, share: Tensor) -> Tensor:
    """From one `#rrggbb` to another; what lies outside 0..1 is cut. [N] -> [N,3]"""
    return torch.lerp(parse_color(dark), parse_color(light), share.clamp(0, 1)[:, None])


def flat(color: str, points: Tensor) -> Tensor:
    """One `#rrggbb` everywhere. [N,3] -> [N,3]"""
    return parse_color(color).expand(len(points), 3)


def mix(under: Tensor, over: Tensor, share: Tensor) -> Tensor:
    """`over` where `share` is 1. [N,3], [N,3], [N] -> [N,3]"""
    return torch.lerp(under, over, share.clamp(0, 1)[:, None])


_PROBES = 600
_MAX_DRAWN = 10_000  # per Gaussian kept; a part of which less shows is misplaced


@dataclass(frozen=True)
class DemoScene:
    """A scene of which everything is known."""

    gaussians: Gaussians  # the scene
    labels: Tensor  # which part each Gaussian belongs to, an index into `label_names`. [N] uint8
    label_names: tuple[str, ...]  # what the labels mean
    cameras: tuple[Camera, ...]  # around the scene, framing it, even in azimuth
    up: Tensor  # world direction that is up. [3]
    background: tuple[float, float, float]  # what stands behind it in pictures, sRGB

    def members(self, *names: str) -> Tensor:
        """Sorted indices of the Gaussians of the named parts. [M] int64"""
        unknown = [name for name in names if name not in self.label_names]
        if unknown:
            raise ProgdfError(f"the scene has no part '{unknown[0]}'; it has {', '.join(self.label_names)}")
        ids = torch.tensor([self.label_names.index(name) for name in names], dtype=torch.uint8)
        return torch.isin(self.labels, ids).nonzero()[:, 0]


def assemble(
    parts: Sequence[Part],
    label_names: tuple[str, ...],
    paint: Painter,
    size: int,
    seed: int,
    daylight: Daylight = OUTDOORS,
) -> tuple[Gaussians, Tensor]:
    """Exactly `size` Gaussians on the visible surfaces of `parts`, and their labels [N] uint8; seeded."""
    random = torch.Generator().manual_seed(seed)
    table = lattice(seed)
    pieces = list[Gaussians]()
    labels = list[Tensor]()
    with one_thread():  # hundreds of small tensor operations
        counts, shares = _budget(parts, size)
        for part, count, share in zip(parts, counts, shares, strict=True):
            at = _sample_visible(parts, part, count, share, random)
            pieces.append(_make_gaussians(parts, part, at, paint(part, at, table), daylight, random))
            labels.append(torch.full((count,), label_names.index(part.label), dtype=torch.uint8))
    return concatenate(pieces), torch.cat(labels)


def _budget(parts: Sequence[Part], size: int) -> tuple[list[int], list[float]]:
    """How many Gaussians each part gets, adding up to `size`, and the share of its surface that shows."""
    wishes = []
    shares = []
    for part in parts:
        probes = sample(part, _PROBES)
        share = float(_is_outside(parts, part, probes).float().mean())
        # five digits: what equal parts get must not hang on the last bits, which depend on the processor
        wishes.append(float(f"{float((probes.spacing**2).sum()) * share * part.weight:.5g}"))
        shares.append(max(share, 1 / _PROBES))
    quotas = [max(1.0, size * wish / sum(wishes)) for wish in wishes]
    quotas = [quota * size / sum(quotas) for quota in quotas]
    counts = [math.floor(quota) for quota in quotas]
    by_surplus = sorted(range(len(parts)), key=lambda i: (counts[i] - quotas[i], -i))
    for i in by_surplus[: size - sum(counts)]:
        counts[i] += 1
    return counts, shares


def _is_outside(parts: Sequence[Part], outer: Part, at: Samples) -> Tensor:
    """Which samples lie on the outside of all other parts, or just below their skin. [N] bool"""
    visible = torch.ones(len(at), dtype=torch.bool)
    for part in parts:
        if part is not outer and part.touches(outer):
            visible &= part.depth(at.points) <= 0.6 * at.spacing.clamp_max(0.03)
            if part.clears > outer.clears:
                visible &= part.shape.level(part.to_local(at.points)) > 1 + part.clears
    return visible


def _sample_visible(
    parts: Sequence[Part], part: Part, count: int, share: float, random: torch.Generator
) -> Samples:
    """Exactly `count` shown samples of a part: enough are drawn, the few too many are dropped at random."""
    drawn = math.ceil(count / share)
    while True:
        at = sample(part, drawn)
        rows = _is_outside(parts, part, at).nonzero()[:, 0]
        if len(rows) >= count:
            break
        if drawn > _MAX_DRAWN * count:
            raise ValueError(f"{part.name} at {part.center.tolist()} lies inside other parts; move it")
        drawn = max(drawn + 1, math.ceil(1.01 * drawn * count / max(len(rows), 1)))
    chosen = torch.randperm(len(rows), generator=random)[:count].sort().values
    return at[rows[chosen]]


def _make_gaussians(
    parts: Sequence[Part],
    part: Part,
    at: Samples,
    coat: SurfacePaint,
    daylight: Daylight,
    random: torch.Generator,
) -> Gaussians:
    """Light and shape the painted Gaussians of one part."""
    n = len(at)
    grain = torch.randn(n, generator=random)
    leaning = at.normals + coat.relief - (coat.relief * at.normals).sum(1, keepdim=True) * at.normals
    leaning = leaning / leaning.norm(dim=1, keepdim=True)
    stands = (torch.rand(n, generator=random) < coat.pelt.standing).float()
    albedo = linear_from_srgb((coat.color * (1 + 0.05 * grain + 0.10 * stands)[:, None]).clamp(0, 1))
    color = (
        coat.color if coat.glows else develop(albedo * irradiance(at.points, leaning, parts, part, daylight))
    )
    glow, band = view_dependent_light(at.normals, coat.velvet, coat.gloss, 0.35 + 0.65 * color)
    means, quats, log_scales = _place_gaussians(at, coat, stands, random)
    opacity = 0.97 - 0.10 * torch.rand(n, generator=random) - 0.25 * stands
    return Gaussians(means, quats, log_scales, torch.logit(opacity), rgb_to_sh0(color + glow), band)


def _place_gaussians(
    at: Samples, coat: SurfacePaint, stands: Tensor, random: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Flat Gaussians on the surface, hairs and blades standing out of it. -> means, quats, log_scales"""
    n = len(at)
    pelt = coat.pelt
    h = at.spacing[:, None]
    up = stands[:, None]
    flow = torch.zeros(n, 3) if coat.flow is None else coat.flow
    flow = flow + max(pelt.unruly, 1e-3) * torch.randn(n, 3, generator=random)
    along = flow - (flow * at.normals).sum(1, keepdim=True) * at.normals
    along = along / along.norm(dim=1, keepdim=True).clamp_min(1e-6) + pelt.rise * up * at.normals
    along = along / along.norm(dim=1, keepdim=True)
    across = torch.linalg.cross(at.normals, along)
    across = across / across.norm(dim=1, keepdim=True).clamp_min(1e-6)
    frame = torch.stack([along, across, torch.linalg.cross(along, across)], dim=2)

    # those that lie cover for those that stand
    flat = torch.tensor(pelt.flat) * h / (1 - pelt.standing) ** 0.5
    hair = torch.tensor(pelt.hair) * h + torch.tensor([pelt.length, 0.0, 0.0])
    scales = torch.where(up > 0, hair, flat) * torch.exp(0.12 * torch.randn(n, 3, generator=random))
    height = pelt.lift * hair[:, :1] * up + 0.06 * h * torch.randn(n, 1, generator=random)
    return at.points + height * at.normals, matrix_quats(frame), scales.log()
