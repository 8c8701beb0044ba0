"""From parts and paint to a scene: how many Gaussians where, which show, how they lie, how they are lit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians, normalize_quats
from progdf.sh import rgb_to_sh0
from progdf.threads import one_thread

from .light import OUTDOORS, Daylight, develop, irradiance, linear_from_srgb, view_dependent_light
from .noise import lattice
from .paint import Paint, Painter
from .surface import Part, Samples, sample

_PROBES = 600
_MOST_DRAWN = 10_000  # per Gaussian kept; a part of which less shows is misplaced


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
    pieces: list[Gaussians] = []
    labels: list[Tensor] = []
    with one_thread():  # hundreds of small tensor operations
        counts, shown = _budget(parts, size)
        for part, count, share in zip(parts, counts, shown, strict=True):
            at = _sample_visible(parts, part, count, share, random)
            pieces.append(_make_gaussians(parts, part, at, paint(part, at, table), daylight, random))
            labels.append(torch.full((count,), label_names.index(part.label), dtype=torch.uint8))
    return _concatenate(pieces), torch.cat(labels)


def _budget(parts: Sequence[Part], size: int) -> tuple[list[int], list[float]]:
    """How many Gaussians each part gets, adding up to `size`, and the share of its surface that shows."""
    wishes, shown = [], []
    for part in parts:
        probes = sample(part, _PROBES)
        share = float(_is_shown(parts, part, probes).float().mean())
        # five digits: what equal parts get must not hang on the last bits, which depend on the processor
        wishes.append(float(f"{float((probes.spacing**2).sum()) * share * part.weight:.5g}"))
        shown.append(max(share, 1 / _PROBES))
    quotas = [max(1.0, size * wish / sum(wishes)) for wish in wishes]
    quotas = [quota * size / sum(quotas) for quota in quotas]
    counts = [math.floor(quota) for quota in quotas]
    rest = sorted(range(len(parts)), key=lambda i: (counts[i] - quotas[i], -i))
    for i in rest[: size - sum(counts)]:
        counts[i] += 1
    return counts, shown


def _is_shown(parts: Sequence[Part], own: Part, at: Samples) -> Tensor:
    """Which samples lie on the outside of all other parts, or just below their skin. [N] bool"""
    shown = torch.ones(len(at), dtype=torch.bool)
    for part in parts:
        if part is not own and part.touches(own):
            shown &= part.depth(at.points) <= 0.6 * at.spacing.clamp_max(0.03)
            if part.clears > own.clears:
                shown &= part.shape.level(part.to_local(at.points)) > 1 + part.clears
    return shown


def _sample_visible(
    parts: Sequence[Part], part: Part, count: int, share: float, random: torch.Generator
) -> Samples:
    """Exactly `count` shown samples of a part: enough are drawn, the few too many are dropped at random."""
    drawn = math.ceil(count / share)
    while True:
        at = sample(part, drawn)
        kept = _is_shown(parts, part, at).nonzero()[:, 0]
        if len(kept) >= count:
            break
        if drawn > _MOST_DRAWN * count:
            raise ValueError(f"{part.name} at {part.center.tolist()} lies inside other parts; move it")
        drawn = max(drawn + 1, math.ceil(1.01 * drawn * count / max(len(kept), 1)))
    chosen = torch.randperm(len(kept), generator=random)[:count].sort().values
    return at[kept[chosen]]


def _make_gaussians(
    parts: Sequence[Part], part: Part, at: Samples, coat: Paint, daylight: Daylight, random: torch.Generator
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
    at: Samples, coat: Paint, stands: Tensor, random: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Flat Gaussians on the surface, hairs and blades standing out of it. -> means, quats, log_scales"""
    n, pelt = len(at), coat.pelt
    h, up = at.spacing[:, None], stands[:, None]
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
    return at.points + height * at.normals, _quats(frame), scales.log()


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


def _concatenate(pieces: Sequence[Gaussians]) -> Gaussians:
    joined: dict[str, Any] = {name: torch.cat([getattr(p, name) for p in pieces]) for name in ATTRIBUTES}
    return Gaussians(**joined)
