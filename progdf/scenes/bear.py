"""The demo's bear: seated on a stone plinth in the grass, as Gaussians with exact labels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, normalize_quats
from progdf.scenes.bear_paint import FUR, WOOL, paint
from progdf.scenes.bear_parts import LABELS, bear_parts
from progdf.scenes.light import develop, irradiance, linear_from_srgb, sheen
from progdf.scenes.noise import lattice, noise
from progdf.scenes.surface import Part, Samples, sample
from progdf.sh import rgb_to_sh0

SMALLEST = 400
"""Fewer Gaussians than this are no bear."""

_PROBES = 600


@dataclass(frozen=True)
class DemoScene:
    """A scene of which everything is known.

    Args:
        gaussians: the scene
        labels: which part each Gaussian belongs to, an index into `label_names`. [N] uint8
        label_names: what the labels mean
        cameras: around the scene, framing it, even in azimuth
        up: world direction that is up. [3]
        background: what stands behind it in pictures, sRGB
    """

    gaussians: Gaussians
    labels: Tensor
    label_names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    up: Tensor
    background: tuple[float, float, float]

    def members(self, *names: str) -> Tensor:
        """Sorted indices of the Gaussians of the named parts. [M] int64"""
        unknown = [name for name in names if name not in self.label_names]
        if unknown:
            raise ProgdfError(f"the scene has no part '{unknown[0]}'; it has {', '.join(self.label_names)}")
        ids = torch.tensor([self.label_names.index(name) for name in names], dtype=torch.uint8)
        return torch.isin(self.labels, ids).nonzero()[:, 0]


def bear(size: int = 24_000, seed: int = 0) -> DemoScene:
    """A teddy bear of exactly `size` Gaussians; the same seed gives the same bear, bit for bit.

    Raises:
        ProgdfError: fewer than `SMALLEST` Gaussians.
    """
    if size < SMALLEST:
        raise ProgdfError(f"{size} Gaussians are too few for a bear; at least {SMALLEST} would be right")
    with _one_thread():
        return _grow(bear_parts(), size, seed)


def _grow(parts: Sequence[Part], size: int, seed: int) -> DemoScene:
    random = torch.Generator().manual_seed(seed)
    table = lattice(seed)
    counts, shown = _budget(parts, size)
    pieces: list[Gaussians] = []
    labels: list[Tensor] = []
    for part, count, share in zip(parts, counts, shown, strict=True):
        at = _visible(parts, part, count, share, random)
        pieces.append(_clothe(parts, part, at, table, random))
        labels.append(torch.full((count,), LABELS.index(part.label), dtype=torch.uint8))
    return DemoScene(
        _joined(pieces),
        torch.cat(labels),
        LABELS,
        _rig(),
        torch.tensor([0.0, 1.0, 0.0]),
        (0.749, 0.847, 0.945),
    )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Hundreds of small tensor operations: more threads only wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _budget(parts: Sequence[Part], size: int) -> tuple[list[int], list[float]]:
    """How many Gaussians each part gets, adding up to `size`, and the share of its surface that shows."""
    wishes, shown = [], []
    for part in parts:
        probes = sample(part, _PROBES)
        share = float(_is_shown(parts, part, probes).float().mean())
        wishes.append(float((probes.spacing**2).sum()) * share * part.weight)
        shown.append(max(share, 1 / _PROBES))
    quotas = [max(1.0, size * wish / sum(wishes)) for wish in wishes]
    quotas = [quota * size / sum(quotas) for quota in quotas]
    counts = [math.floor(quota) for quota in quotas]
    rest = sorted(range(len(parts)), key=lambda i: counts[i] - quotas[i])
    for i in rest[: size - sum(counts)]:
        counts[i] += 1
    return counts, shown


def _is_shown(parts: Sequence[Part], own: Part, at: Samples) -> Tensor:
    """Which samples lie on the outside of all other parts, or just below their skin. [N] bool"""
    shown = torch.ones(len(at), dtype=torch.bool)
    for part in parts:
        if part is not own and (part.name == "grass" or part.touches(own)):
            shown &= part.depth(at.points) <= 0.6 * at.spacing.clamp_max(0.03)
            if part.clears and (not own.clears or part.name == "glint"):
                shown &= part.shape.level(part.to_local(at.points)) > 1 + part.clears
    return shown


def _visible(parts: Sequence[Part], part: Part, count: int, share: float, random: torch.Generator) -> Samples:
    """Exactly `count` shown samples of a part: enough are drawn, the few too many are dropped at random."""
    drawn = math.ceil(count / share)
    while True:
        at = sample(part, drawn)
        kept = _is_shown(parts, part, at).nonzero()[:, 0]
        if len(kept) >= count:
            break
        drawn = max(drawn + 1, math.ceil(1.01 * drawn * count / max(len(kept), 1)))
    chosen = torch.randperm(len(kept), generator=random)[:count].sort().values
    return at[kept[chosen]]


def _clothe(
    parts: Sequence[Part], part: Part, at: Samples, table: Tensor, random: torch.Generator
) -> Gaussians:
    """Paint, light and shape the Gaussians of one part."""
    coat = paint(part, at, table)
    n = len(at)
    grain = torch.randn(n, generator=random)
    leaning = at.normals + coat.relief - (coat.relief * at.normals).sum(1, keepdim=True) * at.normals
    leaning = leaning / leaning.norm(dim=1, keepdim=True)
    light = irradiance(at.points, leaning, parts, part)
    strand = _strands(part, n, random)
    albedo = linear_from_srgb((coat.color * (1 + 0.05 * grain[:, None] + 0.10 * strand[:, None])).clamp(0, 1))
    color = coat.color if part.name == "glint" else develop(albedo * light)
    glow, band = sheen(at.normals, coat.velvet, coat.gloss, 0.35 + 0.65 * color)
    means, quats, log_scales = _lay(part, at, table, strand, random)
    opacity = (0.97 - 0.10 * torch.rand(n, generator=random) - 0.25 * strand).clamp(0.05, 0.99)
    return Gaussians(means, quats, log_scales, torch.logit(opacity), rgb_to_sh0(color + glow), band)


def _strands(part: Part, n: int, random: torch.Generator) -> Tensor:
    """1 for Gaussians that stand out of the surface as hairs or blades, 0 for those that cover it. [N]"""
    return (torch.rand(n, generator=random) < _standing(part)).float()


def _standing(part: Part) -> float:
    """The share of a part's Gaussians that are hairs or blades."""
    if part.name == "grass":
        return 0.55
    return 0.22 if part.name in FUR else 0.05 if part.name in WOOL else 0.0


def _lay(
    part: Part, at: Samples, table: Tensor, strand: Tensor, random: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Flat Gaussians on the surface, hairs and blades standing out of it. -> means, quats, log_scales"""
    n = len(at)
    h = at.spacing[:, None]
    stands = strand[:, None]
    furry = part.name in FUR
    swirl = torch.stack([noise(at.points + 3.1 * k, table, 2.5) for k in range(3)], dim=1)
    flow = torch.tensor([0.0, 1.0 if part.name == "grass" else -1.0, 0.0]) + 0.7 * swirl
    flow = flow + 0.35 * torch.randn(n, 3, generator=random)
    if part.name in WOOL:  # along the stripes, which keeps their edges crisp
        forth = torch.stack([at.local[:, 2], torch.zeros(n), -at.local[:, 0]], dim=1) @ part.matrix.T
        flow = (
            torch.linalg.cross(at.normals, forth) if part.name == "scarf" else part.matrix[:, 0].expand(n, 3)
        )
    along = flow - (flow * at.normals).sum(1, keepdim=True) * at.normals
    along = along / along.norm(dim=1, keepdim=True).clamp_min(1e-6)
    rise = 1.6 if part.name == "grass" else 0.45
    along = along + rise * stands * at.normals
    along = along / along.norm(dim=1, keepdim=True)
    across = torch.linalg.cross(at.normals, along)
    across = across / across.norm(dim=1, keepdim=True).clamp_min(1e-6)
    frame = torch.stack([along, across, torch.linalg.cross(along, across)], dim=2)

    shape = [0.85, 0.58, 0.16] if furry else [0.80, 0.50, 0.14] if part.name in WOOL else [0.64, 0.64, 0.14]
    flat = torch.tensor(shape) * h / (1 - _standing(part)) ** 0.5
    # fur keeps some length however fine the sampling
    hair = torch.cat([(0.95 * h).clamp_min(0.013), 0.24 * h, 0.16 * h], dim=1)
    if part.name == "grass":
        flat = 1.3 * flat
        hair = torch.cat([0.45 * h + 0.022, 0.16 * h, 0.10 * h], dim=1)
    scales = torch.where(stands > 0, hair, flat) * torch.exp(0.12 * torch.randn(n, 3, generator=random))
    lift = (0.5 * hair[:, :1] if part.name == "grass" else 0.35 * hair[:, :1]) * stands
    jitter = 0.06 * h * torch.randn(n, 1, generator=random)
    means = at.points + (lift + jitter) * at.normals
    return means, _quats(frame), scales.log()


def _quats(frames: Tensor) -> Tensor:
    """Rotation matrices as quaternions wxyz, by the largest of the four components. [N,3,3] -> [N,4]"""
    m = frames
    x, y, z = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    a, b, c = m[:, 2, 1], m[:, 0, 2], m[:, 1, 0]
    d, e, f = m[:, 1, 2], m[:, 2, 0], m[:, 0, 1]
    candidates = torch.stack(
        [
            torch.stack([1 + x + y + z, a - d, b - e, c - f], 1),
            torch.stack([a - d, 1 + x - y - z, c + f, b + e], 1),
            torch.stack([b - e, c + f, 1 - x + y - z, a + d], 1),
            torch.stack([c - f, b + e, a + d, 1 - x - y + z], 1),
        ],
        dim=1,
    )
    best = torch.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], 1).argmax(1)
    quats = candidates[torch.arange(len(m)), best]
    return normalize_quats(quats)


def _joined(pieces: Sequence[Gaussians]) -> Gaussians:
    return Gaussians(
        *(
            torch.cat([getattr(piece, name) for piece in pieces])
            for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
        )
    )


def _rig(count: int = 32, width: int = 512, height: int = 512) -> tuple[Camera, ...]:
    """Cameras around the bear, the first in front, 4 to 42 degrees above the horizon."""
    centre = torch.tensor([0.0, 0.78, 0.12])
    K = intrinsics(math.radians(40), width, height)
    cameras = []
    for i in range(count):
        azimuth = 2 * math.pi * i / count
        elevation = math.radians(4 + 38 * ((0.22 + i * 0.618034) % 1.0))
        direction = torch.tensor(
            [
                math.sin(azimuth) * math.cos(elevation),
                math.sin(elevation),
                math.cos(azimuth) * math.cos(elevation),
            ]
        )
        viewmat = look_at(centre + 4.6 * direction, centre, torch.tensor([0.0, 1.0, 0.0]))
        cameras.append(Camera(viewmat, K, width, height, name=f"bear_{i:03d}"))
    return tuple(cameras)
