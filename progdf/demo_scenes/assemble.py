"""Conversion of painted parts to a scene: distribution, visibility, shape and lighting of the Gaussians."""

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
from progdf.system.equality import equal_fields
from progdf.threads import one_thread

from .light import OUTDOORS, Daylight, develop, irradiance, view_dependent_light
from .surface import Part, Samples, sample

_LATTICE_CELLS = 64  # cells after which the lattice repeats; a power of two


def lattice(seed: int) -> Tensor:
    """Return random numbers from −1 to 1 on a lattice of 64³ nodes, for `noise`. [64³] float32"""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(_LATTICE_CELLS**3, generator=generator) * 2 - 1


def noise(points: Tensor, table: Tensor, frequency: float, octaves: int = 1) -> Tensor:
    """Return value noise, −1 to 1, with a mean of about 0.

    Args:
        points: positions. [N,3]
        table: numbers from `lattice`
        frequency: cells per world unit
        octaves: number of layers, ≥ 1; each doubles the frequency and halves the height

    Returns:
        Noise values. [N]
    """
    total = torch.zeros(points.shape[0])
    height = 1.0
    span = 0.0
    for octave in range(octaves):
        # the shift separates the lattice planes of the octaves and the planes of symmetry of the part
        total += height * _value_noise(points * frequency + 17.31 * (octave + 1), table)
        span += height
        height = height / 2
        frequency = frequency * 2
    return total / span


def _value_noise(places: Tensor, table: Tensor) -> Tensor:
    cell = places.floor()
    f = smoothstep(places - cell)
    low = cell.long() & (_LATTICE_CELLS - 1)
    high = (low + 1) & (_LATTICE_CELLS - 1)
    x = (low[:, 0] * _LATTICE_CELLS * _LATTICE_CELLS, high[:, 0] * _LATTICE_CELLS * _LATTICE_CELLS)
    y = (low[:, 1] * _LATTICE_CELLS, high[:, 1] * _LATTICE_CELLS)
    z = (low[:, 2], high[:, 2])
    planes = []
    for i in range(2):
        rows = [torch.lerp(table[x[i] + y[j] + z[0]], table[x[i] + y[j] + z[1]], f[:, 2]) for j in range(2)]
        planes.append(torch.lerp(rows[0], rows[1], f[:, 1]))
    return torch.lerp(planes[0], planes[1], f[:, 0])


@dataclass(frozen=True)
class GaussianLayout:
    """Shape and orientation of a surface's Gaussians. Most lie flat, some stand out as hairs or blades."""

    standing: float = 0.0  # share of Gaussians that stand out, 0 to 1
    # standard deviations along the flow, across it and through the surface, in sample spacings
    flat: tuple[float, float, float] = (0.64, 0.64, 0.14)
    hair: tuple[float, float, float] = (0.70, 0.24, 0.16)  # the same for hairs
    # added to a hair's first standard deviation, world units: a minimum length for any sample spacing
    length: float = 0.0
    rise: float = 0.45  # slope of a hair; 0 lies flat, 1 is 45 degrees
    lift: float = 0.35  # height of a hair's middle above the surface, in its first standard deviation
    unruly: float = 0.35  # random variation of directions between neighbors


BARE = GaussianLayout()
"""Surface without hairs."""


@dataclass(frozen=True)
class SurfacePaint:
    """Appearance of a surface before lighting."""

    __eq__ = equal_fields

    color: Tensor  # sRGB, 0 to 1. [N,3]
    relief: Tensor  # offset of the normals, for lighting only. [N,3]
    velvet: float = 0.0  # brightening where the surface turns away from the eye, sRGB units
    gloss: float = 0.0  # specular highlight, sRGB units
    # direction of hairs and flat Gaussians; only its component along the surface counts. [N,3]
    flow: Tensor | None = None
    pelt: GaussianLayout = BARE  # shape and orientation of the Gaussians
    glows: bool = False  # emissive: `color` is visible without lighting


Painter = Callable[[Part, Samples, Tensor], SurfacePaint]
"""Function from a part, its samples and the noise table to their paint."""


def bumps(points: Tensor, table: Tensor, frequency: float, height: float) -> Tensor:
    """Return a relief of noise, see `SurfacePaint.relief`. [N,3] -> [N,3]"""
    offsets = torch.tensor([[0.0, 0.0, 0.0], [5.2, 1.3, 8.1], [2.7, 9.4, 4.6]])
    return height * torch.stack([noise(points + offset, table, frequency, 2) for offset in offsets], dim=1)


def swirl(points: Tensor, table: Tensor, main: tuple[float, float, float], height: float = 0.7) -> Tensor:
    """Return a flow along `main`, bent by noise. [N,3] -> [N,3]"""
    bend = torch.stack([noise(points + 3.1 * k, table, 2.5) for k in range(3)], dim=1)
    return torch.tensor(main) + height * bend


def mix_colors(dark: str, light: str, share: Tensor) -> Tensor:
    """Interpolate from one `#rrggbb` to another by a share, clamped to 0 to 1. [N] -> [N,3]"""
    return torch.lerp(parse_color(dark), parse_color(light), share.clamp(0, 1)[:, None])


def flat(color: str, points: Tensor) -> Tensor:
    """Return the color `#rrggbb` for each point. [N,3] -> [N,3]"""
    return parse_color(color).expand(len(points), 3)


def mix(under: Tensor, over: Tensor, share: Tensor) -> Tensor:
    """Interpolate from `under` to `over` by a share, clamped to 0 to 1. [N,3], [N,3], [N] -> [N,3]"""
    return torch.lerp(under, over, share.clamp(0, 1)[:, None])


_PROBES = 600  # samples that estimate the visible share of a part
_MAX_SAMPLES_PER_GAUSSIAN = 10_000  # samples per visible Gaussian; a part that needs more is misplaced


@dataclass(frozen=True)
class DemoScene:
    """Scene with labels and cameras."""

    __eq__ = equal_fields

    gaussians: Gaussians  # the scene
    labels: Tensor  # label of each Gaussian, an index into `label_names`. [N] uint8
    label_names: tuple[str, ...]  # names of the labels
    cameras: tuple[Camera, ...]  # cameras that view the scene, evenly spaced in azimuth
    up: Tensor  # world direction that is up. [3]
    background: tuple[float, float, float]  # background color of pictures, sRGB

    def members(self, *names: str) -> Tensor:
        """Return the sorted indices of the Gaussians with the given labels. [M] int64"""
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
    """Return exactly `size` Gaussians on the visible surfaces of parts, and their labels [N] uint8."""
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
    """Return each part's number of Gaussians, with sum `size`, and the visible share of its surface."""
    weights = []
    shares = []
    for part in parts:
        probes = sample(part, _PROBES)
        share = float(_is_outside(parts, part, probes).float().mean())
        # five digits, so that rounding, which depends on the processor, does not decide between equal parts
        weights.append(float(f"{float((probes.spacing**2).sum()) * share * part.weight:.5g}"))
        shares.append(max(share, 1 / _PROBES))
    quotas = [max(1.0, size * weight / sum(weights)) for weight in weights]
    quotas = [quota * size / sum(quotas) for quota in quotas]
    counts = [math.floor(quota) for quota in quotas]
    by_surplus = sorted(range(len(parts)), key=lambda i: (counts[i] - quotas[i], -i))
    for i in by_surplus[: size - sum(counts)]:
        counts[i] += 1
    return counts, shares


def _is_outside(parts: Sequence[Part], outer: Part, at: Samples) -> Tensor:
    """Return a mask of samples outside all other parts, or just below their surface. [N] bool"""
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
    """Return exactly `count` visible samples of a part; surplus samples are dropped at random."""
    drawn = math.ceil(count / share)
    while True:
        at = sample(part, drawn)
        rows = _is_outside(parts, part, at).nonzero()[:, 0]
        if len(rows) >= count:
            break
        if drawn > _MAX_SAMPLES_PER_GAUSSIAN * count:
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
    """Make the Gaussians of one part from its samples, paint and lighting."""
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
    """Return means, quats and log_scales of flat Gaussians on a surface and of hairs that stand out."""
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

    # flat Gaussians are larger, to also cover the area under the standing ones
    flat = torch.tensor(pelt.flat) * h / (1 - pelt.standing) ** 0.5
    hair = torch.tensor(pelt.hair) * h + torch.tensor([pelt.length, 0.0, 0.0])
    scales = torch.where(up > 0, hair, flat) * torch.exp(0.12 * torch.randn(n, 3, generator=random))
    height = pelt.lift * hair[:, :1] * up + 0.06 * h * torch.randn(n, 1, generator=random)
    return at.points + height * at.normals, matrix_quats(frame), scales.log()
