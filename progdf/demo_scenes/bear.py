"""Demo scene of a teddy bear that sits on a stone plinth in the grass."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.color.edits import measure_color, parse_color, recolor_fully, stripe_profile
from progdf.color.oklab import smoothstep
from progdf.errors import ProgdfError

from .assemble import (
    DemoScene,
    GaussianLayout,
    SurfacePaint,
    assemble,
    bumps,
    flat,
    mix,
    mix_colors,
    noise,
    swirl,
)
from .surface import Part, Samples, ball, dome, ring

FUR = ("body", "tail", "head", "muzzle", "ear", "arm", "leg", "foot")
WOOL = ("scarf", "knot", "end")


_COAT = GaussianLayout(standing=0.22, flat=(0.85, 0.58, 0.16), hair=(0.70, 0.24, 0.16), length=0.0063)
_KNIT = GaussianLayout(
    standing=0.05, flat=(0.80, 0.50, 0.14), hair=(0.70, 0.24, 0.16), length=0.0063, unruly=0.0
)
_TURF = GaussianLayout(
    standing=0.55, flat=(0.83, 0.83, 0.18), hair=(0.45, 0.16, 0.10), length=0.022, rise=1.6, lift=0.5
)


def paint_bear(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    """Return the paint of a part at its samples; `table` is the noise table."""
    if part.name in FUR:
        return _fur(part, at, table)
    if part.name in WOOL:
        return _wool(part, at, table)
    if part.name == "plinth":
        return _stone(at, table)
    if part.name == "grass":
        return _lawn(at, table)
    if part.name == "pad":
        color = mix_colors("#d59a78", "#f0c4a2", 0.5 + 0.5 * noise(at.points, table, 22.0, 2))
        return SurfacePaint(color, bumps(at.points, table, 25.0, 0.2), 0.12, 0.03)
    if part.name == "glint":
        return SurfacePaint(flat("#ffffff", at.points), torch.zeros_like(at.points), glows=True)
    if part.name == "mouth":
        return SurfacePaint(flat("#2b1710", at.points), torch.zeros_like(at.points), gloss=0.02)
    return _glass(part, at)


def _fur(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    patches = noise(p, table, 3.0, 2)
    tufts = noise(p * torch.tensor([1.0, 0.45, 1.0]), table, 17.0, 2)
    brown = mix_colors("#6b3f1f", "#b3733a", 0.5 + 0.35 * patches + 0.45 * tufts)
    cream = mix_colors("#c99b63", "#f0d3a2", 0.5 + 0.3 * patches + 0.5 * tufts)
    ragged = 0.07 * noise(p, table, 14.0, 2)
    color = brown
    if part.name == "muzzle":
        color = mix(brown, cream, smoothstep(at.local[:, 2] + ragged, -0.10, 0.10))
    elif part.name == "body":
        belly = torch.hypot(p[:, 0] / 0.31, (p[:, 1] - 0.50) / 0.36)
        front = smoothstep(at.normals[:, 2], 0.0, 0.25)
        color = mix(brown, cream, smoothstep(1.0 - belly + 1.3 * ragged, -0.10, 0.06) * front)
    elif part.name == "ear":
        inner = at.local[:, 0] ** 2 + (at.local[:, 1] + 0.06) ** 2
        rose = mix_colors("#b97f5c", "#e3b08c", 0.5 + 0.5 * tufts)
        color = mix(
            brown, rose, smoothstep(0.46 - inner + 1.2 * ragged, -0.08, 0.08) * (at.local[:, 2] > 0).float()
        )
    elif part.name in ("head", "arm"):
        color = mix(
            brown, mix_colors("#55301a", "#8a5228", 0.5 + 0.5 * tufts), 0.35 * smoothstep(patches, 0.1, 0.5)
        )
    down = swirl(p, table, (0.0, -1.0, 0.0))
    return SurfacePaint(color, bumps(p, table, 15.0, 0.34), 0.17, 0.02, down, _COAT)


def _wool(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    if part.name == "scarf":
        along = torch.atan2(at.local[:, 0], at.local[:, 2]) / (2 * math.pi)
        periods = 13 * along
        ribs = 150 * along
    else:
        along = at.local[:, 1] * torch.linalg.svdvals(part.matrix)[0]
        periods = along / (0.30 if part.name == "knot" else 0.135)
        ribs = along / 0.0145
    red = stripe_profile(periods, width=0.52, softness=0.05)
    color = mix(mix_colors("#e9dfcc", "#fffaf0", 0.6 + 0.4 * noise(p, table, 25.0)), flat("#c8102e", p), red)
    knit = (ribs * 2 * math.pi).sin() * smoothstep(0.013 - at.spacing, 0.0, 0.006)
    fuzz = 1 + 0.07 * noise(p, table, 40.0) + 0.10 * knit
    color = (color * fuzz[:, None]).clamp(0, 1)
    # along the stripes, for crisp edges
    forth = torch.stack([at.local[:, 2], torch.zeros(len(p)), -at.local[:, 0]], dim=1) @ part.matrix.T
    around = torch.linalg.cross(at.normals, forth) if part.name == "scarf" else part.matrix[:, 0].expand_as(p)
    return SurfacePaint(color, bumps(p, table, 22.0, 0.22), 0.09, 0.02, around, _KNIT)


def _stone(at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    grain = noise(p, table, 4.0, 4)
    speckle = noise(p, table, 45.0)
    color = mix_colors("#6f6a64", "#bdb6a8", 0.52 + 0.55 * grain + 0.12 * speckle)
    vein = 1 - (noise(p, table, 2.3, 3).abs() / 0.035).clamp(0, 1)
    color = mix(color, flat("#4b4742", p), 0.55 * vein)
    level = smoothstep(-at.normals[:, 1], -0.8, 0.0)
    low = smoothstep(-p[:, 1], 0.10, 0.30) + smoothstep(grain, 0.25, 0.5) * level
    moss = mix_colors("#4c5a2a", "#7a8a3c", 0.5 + 0.5 * noise(p, table, 20.0))
    color = mix(color, moss, 0.55 * low.clamp(0, 1) * smoothstep(noise(p, table, 5.0, 2), -0.25, 0.3))
    return SurfacePaint(color, bumps(p, table, 7.0, 0.30), gloss=0.05)


def _lawn(at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    meadow = noise(p, table, 0.9, 3)
    detail = noise(p, table, 9.0, 2)
    color = mix_colors("#2f5a1b", "#7fae3a", 0.45 + 0.6 * meadow + 0.35 * detail)
    up = swirl(p, table, (0.0, 1.0, 0.0))
    return SurfacePaint(color, bumps(p, table, 6.0, 0.35), 0.06, 0.0, up, _TURF)


def _glass(part: Part, at: Samples) -> SurfacePaint:
    """Paint eyes and nose nearly black, with a faint reflection of the sky on the nose."""
    p = at.points
    color = flat("#17100d" if part.name == "eye" else "#1d1412", p)
    if part.name == "nose":
        shine = at.local @ torch.tensor([-0.252, 0.806, 0.554])
        color = mix(color, flat("#cfc9c6", p), 0.7 * smoothstep(shine, 0.90, 0.985))
    return SurfacePaint(color, torch.zeros_like(p), gloss=0.12)


LABELS = ("body", "head", "ears", "arms", "legs", "scarf", "plinth", "grass")

Triple = tuple[float, float, float]


def rotation_matrix(degrees: Triple) -> Tensor:
    """Return the matrix of a rotation about x, then y, then z, in degrees. [3,3]"""
    matrix = torch.eye(3)
    for axis, angle in enumerate(degrees):
        c = math.cos(math.radians(angle))
        s = math.sin(math.radians(angle))
        rotation = torch.eye(3)
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        rotation[i, i] = c
        rotation[j, j] = c
        rotation[i, j] = -s
        rotation[j, i] = s
        matrix = rotation @ matrix
    return matrix


def ellipsoid(
    name: str,
    label: str,
    center: Triple,
    radii: Triple,
    turn: Triple = (0.0, 0.0, 0.0),
    weight: float = 1.0,
    exponent: float = 2.0,
    casts_shadow: bool = True,
    clears: float = 0.0,
) -> Part:
    """Return an ellipsoid, rotated by `turn` degrees about x, then y, then z.

    For the other arguments see `Part`.
    """
    matrix = rotation_matrix(turn) @ torch.diag(torch.tensor(radii))
    return Part(
        name,
        label,
        ball(exponent),
        torch.tensor(center),
        matrix,
        weight,
        casts_shadow=casts_shadow,
        clears=clears,
    )


_detail = partial(ellipsoid, weight=7.0, casts_shadow=False, clears=0.16)
"""Ellipsoid for a small, finely sampled part, without fur over it and without a shadow."""


def _eye(x: float) -> list[Part]:
    """Return an eye with the reflection of a window, on the upper side towards the lamp."""
    return [
        _detail("eye", "head", (x, 1.545, 0.432), (0.052, 0.060, 0.042)),
        _detail("glint", "head", (x - 0.017, 1.567, 0.468), (0.015, 0.016, 0.006), weight=30.0, clears=0.3),
    ]


def _pads(foot: Part) -> list[Part]:
    """Return the pads of a sole and four toes, set into the front of the foot."""
    sizes = foot.matrix.norm(dim=0)
    rotation = foot.matrix / sizes
    positions = [((0.0, -0.055), (0.095, 0.085))]
    positions += [
        ((0.132 * math.cos(angle), 0.012 + 0.135 * math.sin(angle)), (0.036, 0.036))
        for angle in (math.radians(28 + 124 / 3 * i) for i in range(4))
    ]
    pads = []
    for (x, y), (wide, tall) in positions:
        z = float(sizes[2]) * math.sqrt(1 - (x / float(sizes[0])) ** 2 - (y / float(sizes[1])) ** 2)
        outward = torch.tensor([x, y, z]) / sizes**2
        outward = outward / outward.norm()
        side = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), outward)
        side = side / side.norm()
        frame = rotation @ torch.stack([side, torch.linalg.cross(outward, side), outward], dim=1)
        matrix = frame @ torch.diag(torch.tensor([wide, tall, 0.022]))
        center = foot.center + rotation @ torch.tensor([x, y, z])
        pads.append(Part("pad", foot.label, ball(), center, matrix, 3.0, casts_shadow=False, clears=0.08))
    return pads


def _pair(
    name: str, label: str, center: Triple, radii: Triple, turn: Triple = (0, 0, 0), weight: float = 1.0
) -> list[Part]:
    """Return a part on the +x side and its mirror image; `turn` is for the +x side."""
    x, y, z = center
    mirrored = (turn[0], -turn[1], -turn[2])
    return [
        ellipsoid(name, label, (x, y, z), radii, turn, weight),
        ellipsoid(name, label, (-x, y, z), radii, mirrored, weight),
    ]


def bear_parts() -> list[Part]:
    """Return all parts of the scene, from the bear to the lawn."""
    feet = _pair("foot", "legs", (0.355, 0.235, 0.80), (0.195, 0.235, 0.115), (-12, 16, 0), weight=1.3)
    return [
        ellipsoid("body", "body", (0.0, 0.57, 0.0), (0.50, 0.60, 0.45)),
        ellipsoid("tail", "body", (0.0, 0.17, -0.44), (0.13, 0.13, 0.13)),
        ellipsoid("head", "head", (0.0, 1.47, 0.05), (0.47, 0.415, 0.42), weight=1.5),
        ellipsoid("muzzle", "head", (0.0, 1.365, 0.40), (0.215, 0.165, 0.19), weight=2.2),
        _detail("nose", "head", (0.0, 1.44, 0.575), (0.085, 0.060, 0.055)),
        _detail("mouth", "head", (0.0, 1.345, 0.588), (0.011, 0.052, 0.018)),
        _detail("mouth", "head", (0.05, 1.292, 0.568), (0.056, 0.011, 0.020), (0, 20, 26)),
        _detail("mouth", "head", (-0.05, 1.292, 0.568), (0.056, 0.011, 0.020), (0, -20, -26)),
        *_eye(0.17),
        *_eye(-0.17),
        *_pair("ear", "ears", (0.335, 1.815, 0.02), (0.175, 0.175, 0.085), (0, 18, -24), weight=1.5),
        *_pair("arm", "arms", (0.505, 0.72, 0.14), (0.155, 0.395, 0.17), (-24, 0, 16)),
        *_pair("leg", "legs", (0.285, 0.185, 0.44), (0.195, 0.40, 0.195), (84, 16, 0)),
        *feet,
        *[pad for foot in feet for pad in _pads(foot)],
        Part(
            "scarf",
            "scarf",
            ring(0.27),
            torch.tensor([0.0, 1.10, 0.03]),
            rotation_matrix((6.0, 0.0, 0.0)) @ torch.diag(torch.tensor([0.350, 0.42, 0.330])),
            weight=3.5,
            casts_shadow=False,
        ),
        ellipsoid("knot", "scarf", (0.13, 1.035, 0.405), (0.085, 0.075, 0.06), (0, 0, -15), 3.5, 2.6, False),
        ellipsoid("end", "scarf", (0.205, 0.825, 0.437), (0.088, 0.235, 0.027), (10, 8, 14), 3.5, 5.0, False),
        ellipsoid("end", "scarf", (0.075, 0.845, 0.462), (0.088, 0.200, 0.027), (10, 2, -8), 3.5, 5.0, False),
        ellipsoid("plinth", "plinth", (0.0, -0.15, 0.20), (1.20, 0.16, 1.20), exponent=7.0, weight=0.55),
        Part(
            "grass",
            "grass",
            dome(0.27),
            torch.tensor([0.0, -0.24, 0.20]),
            torch.diag(torch.tensor([3.6, 3.6, 3.6])),
            weight=0.35,
            density=lambda radius: 1 / (0.08 + radius) ** 1.1,
            casts_shadow=False,
        ),
    ]


_CREAM = "#ece6dc"
_CHARCOAL = "#3a3638"
_MAX_DARK_VALUE = 0.36  # mean sRGB value; fur is brighter, nose and mouth are darker

# ellipses: position in space, half width and half height in world units, and tilt in radians
_PATCHES = (((0.185, 1.53, 0.44), (0.125, 0.165), 0.5), ((-0.185, 1.53, 0.44), (0.085, 0.157), -0.35))
_EYES = (((0.17, 1.545, 0.46), (0.051, 0.058), 0.0), ((-0.17, 1.545, 0.46), (0.045, 0.058), 0.0))
_NOSE_AND_MOUTH = (((0.0, 1.44, 0.60), (0.118, 0.095), 0.0), ((0.02, 1.31, 0.59), (0.118, 0.092), 0.0))


def paint_panda(picture: Tensor, camera: Camera, cover: Callable[[tuple[str, ...]], Tensor]) -> Tensor:
    """Paint a picture of the bear as a panda: head and body cream; limbs, ears and eye patches charcoal.

    The fur's shading is unchanged, as under a multiply layer of a paint program.

    Args:
        picture: render of the bear, sRGB. [H,W,3]
        camera: camera of the render
        cover: function from part names to their share of each pixel, 0 to 1. [H,W]
    """
    head = cover(("head",))
    patches = torch.maximum(*(_ellipse(camera, *patch) for patch in _PATCHES)) * head
    eyes = torch.maximum(*(_ellipse(camera, *eye) for eye in _EYES))
    features = torch.maximum(*(_ellipse(camera, *feature) for feature in _NOSE_AND_MOUTH))
    painted = _wash(picture, cover(("head", "body")), _CREAM)
    painted = _wash(painted, cover(("ears", "arms", "legs")), _CHARCOAL)
    painted = _wash(painted, patches, _CHARCOAL)
    dark = 1 - smoothstep(picture.mean(dim=2), _MAX_DARK_VALUE - 0.12, _MAX_DARK_VALUE)
    mask = torch.maximum(eyes, features * dark) * head
    return torch.lerp(painted, picture, mask[..., None])


def _wash(picture: Tensor, share: Tensor, color: str) -> Tensor:
    """Recolor by a share, 0 to 1, per pixel. [H,W,3], [H,W] -> [H,W,3]"""
    share = (1.5 * share).clamp(0, 1)  # otherwise the old color would remain at soft edges
    washed = recolor_fully(picture, parse_color(color), measure_color(picture, share))
    return torch.lerp(picture, washed, share[..., None])


def _ellipse(
    camera: Camera, center: tuple[float, float, float], radii: tuple[float, float], turn: float
) -> Tensor:
    """Return a tilted ellipse with a soft edge around the projection of a point, 0 to 1. [H,W]"""
    x, y, depth = camera.viewmat[:3, :3] @ torch.tensor(center) + camera.viewmat[:3, 3]
    at = camera.K @ torch.stack([x / depth, y / depth, torch.ones(())])
    rows, columns = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    right = (columns - at[0]) * depth / camera.K[0, 0]
    down = (rows - at[1]) * depth / camera.K[1, 1]
    along = (right * math.cos(turn) + down * math.sin(turn)) / radii[0]
    across = (down * math.cos(turn) - right * math.sin(turn)) / radii[1]
    return ((1 - torch.hypot(along, across)) / 0.12 + 0.5).clamp(0, 1)


MIN_BEAR_GAUSSIANS = 400
"""Smallest number of Gaussians for the bear."""

SKY = (0.510, 0.639, 0.761)
"""Background color, sRGB. It is cold, lighter than fur and darker than snow, so that any coat stands out."""


def bear(size: int = 24_000, seed: int = 0) -> DemoScene:
    """Return a teddy bear of exactly `size` Gaussians.

    The same seed gives the same bits on the same kind of processor.

    Raises:
        ProgdfError: fewer than `MIN_BEAR_GAUSSIANS` Gaussians.
    """
    if size < MIN_BEAR_GAUSSIANS:
        raise ProgdfError(f"{size} Gaussians are too few for a bear; use at least {MIN_BEAR_GAUSSIANS}")
    gaussians, labels = assemble(bear_parts(), LABELS, paint_bear, size, seed)
    return DemoScene(gaussians, labels, LABELS, _rig(), torch.tensor([0.0, 1.0, 0.0]), SKY)


def _rig(count: int = 32, width: int = 512, height: int = 512) -> tuple[Camera, ...]:
    """Return cameras around the bear, the first in front, 4 to 42 degrees above the horizon."""
    center = torch.tensor([0.0, 0.78, 0.12])
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
        viewmat = look_at(center + 4.6 * direction, center, torch.tensor([0.0, 1.0, 0.0]))
        cameras.append(Camera(viewmat, K, width, height, name=f"bear_{i:03d}"))
    return tuple(cameras)
