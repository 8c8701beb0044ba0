"""Builders of shared test scenes: random ones, and hard cases that every engine must survive."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import Gaussians
from progdf.quaternions import normalize_quats
from tests.helpers.draws import Draws


def random_gaussians(
    count: int, seed: int = 0, sh_degree: int = 0, spread: float = 1.0, scale: float = 0.05
) -> Gaussians:
    """Return a cloud around the origin.

    Args:
        count: N
        seed: the same seed gives the same cloud
        sh_degree: 0 to 3
        spread: standard deviation of the centers, world units
        scale: median standard deviation of one Gaussian, world units; axes differ by a factor of about 2
    """
    normal = Draws(seed).normal
    return Gaussians(
        means=normal(count, 3) * spread,
        quats=normal(count, 4),
        log_scales=torch.log(torch.tensor(scale)) + 0.5 * normal(count, 3),
        logit_opacities=normal(count) * 1.5,
        sh0=normal(count, 3),
        shN=0.2 * normal(count, (sh_degree + 1) ** 2 - 1, 3),
    )


def ball(count: int = 2000, radius: float = 1.0, seed: int = 0) -> Gaussians:
    """Return Gaussians inside a ball around the origin."""
    scene = random_gaussians(count, seed=seed, scale=0.01)
    places = torch.nn.functional.normalize(scene.means, dim=1)
    distances = Draws(seed + 1).uniform(count, 1) ** (1 / 3)
    return replace(scene, means=radius * distances * places)


def orbit_camera(
    width: int = 40, height: int = 24, azimuth: float = 0.4, elevation: float = 0.3, distance: float = 4.0
) -> Camera:
    """Return a camera on a sphere around the origin.

    Angles are in radians, y points down, and the vertical field of view is 0.9.
    """
    az = torch.tensor(azimuth).double()
    el = torch.tensor(elevation).double()
    eye = distance * torch.stack([az.sin() * el.cos(), -el.sin(), -az.cos() * el.cos()])
    viewmat = look_at(eye, torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    return Camera(viewmat, intrinsics(0.9, width, height), width, height)


def front_camera(width: int = 40, height: int = 24, focal: float = 30.0) -> Camera:
    """Return a camera at the origin that looks along +z, with axes equal to the world's: x right, y down."""
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(torch.eye(4), K, width, height)


def one_gaussian(
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    scales: tuple[float, float, float] = (0.2, 0.1, 0.15),
    quat: tuple[float, float, float, float] = (0.9, 0.2, -0.3, 0.1),
    opacity: float = 0.8,
    rgb: tuple[float, float, float] = (0.9, 0.3, 0.1),
) -> Gaussians:
    """Return a single Gaussian from activated units: opacity and color 0 to 1, deviations in world units."""
    return Gaussians(
        means=torch.tensor([mean]),
        quats=torch.tensor([quat]),
        log_scales=torch.tensor([scales]).log(),
        logit_opacities=logit_of(torch.tensor([opacity])),
        sh0=(torch.tensor([rgb]) - 0.5) / 0.28209479177387814,
        shN=torch.zeros(1, 0, 3),
    )


def logit_of(opacity: Tensor) -> Tensor:
    """Return logits with a float32 sigmoid as close as possible to `opacity`, not below it. [N] -> [N]"""
    logit = torch.logit(opacity.double()).float()
    for _ in range(64):
        low = logit.sigmoid() < opacity
        if not bool(low.any()):
            break
        logit = torch.where(low, torch.nextafter(logit, torch.full_like(logit, torch.inf)), logit)
    return logit


def concatenate(*parts: Gaussians) -> Gaussians:
    """Return the rows of all parts, in order. All must have the same number of SH bands."""
    return Gaussians(
        **{
            name: torch.cat([getattr(part, name) for part in parts])
            for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
        }
    )


@dataclass(frozen=True)
class HardCase:
    """A scene and a camera that an engine is likely to get wrong.

    Args:
        gaussians: raw parameters
        camera: the view
        poisoned: rows with values that are not finite; all other rows must render as if these were absent
    """

    gaussians: Gaussians
    camera: Camera
    poisoned: tuple[int, ...] = ()


def hard_cases() -> dict[str, HardCase]:
    """Return every hard case by name, for test ids. Small images keep each case quick."""
    front = front_camera()
    cases: dict[str, HardCase] = {}

    def add(name: str, gaussians: Gaussians, camera: Camera = front, **more: object) -> None:
        cases[name] = HardCase(gaussians, camera, **more)  # type: ignore[arg-type]

    some = random_gaussians(60, seed=1, spread=0.6, scale=0.1, sh_degree=3)
    some = replace(some, means=some.means + torch.tensor([0.0, 0.0, 3.0]))
    plain = replace(some, shN=some.shN[:, :0])
    behind = replace(plain, means=plain.means * torch.tensor([1.0, 1.0, -1.0]))

    add("no gaussians", plain[:0])
    add("all culled", behind)
    add("culled ones first", concatenate(behind[:20], plain))
    add("random with SH 3", some)
    add("random in view of an orbit camera", random_gaussians(200, seed=2, sh_degree=2), orbit_camera())
    add("many tiles", random_gaussians(150, seed=3, scale=0.15), orbit_camera(150, 70))

    add("opacity exactly 1", one_gaussian(opacity=1.0))
    add("opacity 0", one_gaussian(opacity=0.0))
    on_pixel = (0.5 / 30.0 * 2.0, 0.5 / 30.0 * 2.0, 2.0)  # projects onto a pixel center
    add("opacity exactly 1/255", one_gaussian(mean=on_pixel, opacity=1 / 255))
    nan = float("nan")
    inf = float("inf")
    for name, value in (("NaN", nan), ("inf", inf), ("-inf", -inf)):
        for attribute in ("means", "log_scales", "quats", "logit_opacities", "sh0"):
            tensor = getattr(plain, attribute).clone()
            tensor[7] = value
            harmless = attribute == "logit_opacities" or (attribute == "log_scales" and value == -inf)
            add(
                f"{name} in {attribute}",
                replace(plain, **{attribute: tensor}),
                poisoned=() if harmless and value == value else (7,),
            )
    stack = one_gaussian(opacity=0.9)
    add("400 opaque ones stacked", _stack(stack, 400))
    add("2000 faint ones stacked", _stack(one_gaussian(opacity=0.012), 2000))

    quat = torch.tensor([0.9, 0.2, -0.3, 0.1])
    for norm in (0.0, 1e-12, 1e12):
        add(f"quaternion norm {norm:g}", replace(one_gaussian(), quats=(quat * norm)[None]))
    for scales in ((0.0, 0.1, 0.2), (0.0, 0.0, 0.2), (0.0, 0.0, 0.0), (4e-9, 4e-9, 4e-9), (1e6, 0.1, 0.1)):
        add(f"scales {scales}", one_gaussian(scales=scales))
    for scale in (1e6, 1e18):
        add(f"scale {scale:g} all around", one_gaussian(scales=(scale, scale, scale)))
    add("scale inf", concatenate(one_gaussian(scales=(inf, 0.1, 0.1)), plain), poisoned=(0,))

    # half of 45 degrees
    c = 0.9238795
    s = 0.3826834
    diagonal = (c, 0.0, 0.0, s)
    for ratio in (5e3, 1e6):
        add(
            f"needle {ratio:g}:1 at 45 degrees",
            one_gaussian(scales=(1e-3 * ratio, 1e-3, 1e-3), quat=diagonal, mean=(0.01, 0.02, 2.0)),
        )
    add(
        "needle off to the side",
        one_gaussian(scales=(300.0, 1e-4, 1e-4), quat=diagonal, mean=(9.0, 9.1, 2.0)),
    )

    for name, z in (("at", 0.01), ("just before", 0.0100001), ("just behind", 0.0099999)):
        add(f"{name} the near plane", one_gaussian(mean=(0.0, 0.0, z), scales=(1e-3, 1e-3, 1e-3)))
    add("at the camera center", one_gaussian(mean=(0.0, 0.0, 0.0)))
    add("behind the camera", one_gaussian(mean=(0.0, 0.0, -2.0)))
    add("center outside, clamp active", one_gaussian(mean=(4.5, 3.0, 2.0), scales=(1.5, 1.0, 1.2)))
    add("center outside on the other side", one_gaussian(mean=(-4.5, -3.0, 2.0), scales=(1.5, 1.0, 1.2)))
    off = torch.tensor([[34.0, 0.0, 9.0], [0.0, 21.0, 17.5], [0.0, 0.0, 1.0]])
    wide = concatenate(plain, one_gaussian(mean=(3.4, -2.0, 2.0), scales=(1.5, 1.0, 1.2)))
    add("principal point off center, fx unequal fy", wide, replace(front, K=off))

    add("far away", one_gaussian(mean=(2e3, 1e3, 1e5), scales=(5e3, 2e3, 1e3)))
    add("coordinates of 2250", replace(plain, means=plain.means * 750), replace(front))
    loud = plain.sh0.clone()
    loud[::3] = 13.0
    loud[1::3] = -13.0
    add("color coefficients of 13", replace(plain, sh0=loud))
    flat = plain.means.clone()
    flat[:, 2] = 3.0
    add("equal depths", replace(plain, means=flat))
    add("depths one ulp apart", replace(plain, means=_one_ulp_apart(flat)))
    turned = orbit_camera(azimuth=1.1, elevation=0.7)
    facing = (_one_ulp_apart(flat).double() - turned.viewmat[:3, 3].double()) @ turned.viewmat[
        :3, :3
    ].double()
    add("depths one ulp apart, turned camera", replace(plain, means=facing.float()), turned)
    for factor in (100.0, 1e4):
        add(f"HDR colors up to {factor:g}", replace(some, sh0=_hdr_sh0(some.sh0, factor)))
    around = random_gaussians(200, seed=6, spread=2.0, scale=0.1, sh_degree=3)
    for degrees in (120.0, 170.0):
        add(f"field of view of {degrees:g} degrees, inside", around, _camera_of_angle(degrees))
    distant = replace(plain, means=plain.means + torch.tensor([0.0, 0.0, 300.0]))
    add("field of view of 0.5 degrees", distant, _camera_of_angle(0.5))
    for width, height in ((1, 1), (17, 5), (33, 9), (64, 16)):
        add(f"image {width}x{height}", plain, front_camera(width, height, focal=0.75 * width))
    tiny = replace(plain, log_scales=plain.log_scales - 3.0)
    add("antialias with tiny splats", replace(tiny, antialiased=True))
    add("antialias with points", replace(one_gaussian(scales=(0.0, 0.0, 0.0)), antialiased=True))
    add("antialias with large splats", replace(plain, antialiased=True))
    return cases


def _camera_of_angle(degrees: float) -> Camera:
    """Return a front camera with this horizontal field of view."""
    return front_camera(focal=20.0 / math.tan(math.radians(degrees) / 2))


def _one_ulp_apart(means: Tensor) -> Tensor:
    """Return means whose depths, in random order, are as close as float32 allows. [N,3]"""
    count = len(means)
    near = means[0, 2].view(torch.int32)
    order = Draws(7).order(count).to(torch.int32)
    depths = (near + order).view(torch.float32)
    return torch.cat([means[:, :2], depths[:, None]], dim=1)


def _hdr_sh0(sh0: Tensor, largest: float) -> Tensor:
    """Return DC coefficients with the same colors times factors from 1 to `largest`. [N,3]"""
    factors = torch.logspace(0.0, math.log10(largest), len(sh0))
    return sh0.abs() * factors[Draws(8).order(len(sh0))][:, None]


def _stack(layer: Gaussians, count: int) -> Gaussians:
    stack = layer[torch.zeros(count, dtype=torch.int64)]
    draws = Draws(5)
    depth = torch.linspace(2.0, 3.0, count)[draws.order(count)]
    return replace(
        stack,
        means=torch.stack([torch.zeros(count), torch.zeros(count), depth], dim=1),
        sh0=draws.normal(count, 3),
    )


def high_chair(count: int = 4000) -> Gaussians:
    """Return a chair without a ground, y up: separate legs, a seat, and a narrower back with upright bars."""
    draw = np.random.default_rng(5)
    part = draw.integers(0, 3, count)
    x, y, z = draw.uniform(-1.0, 1.0, (3, count))
    side_x, side_z = draw.choice([-1.0, 1.0], (2, count))
    legs = part == 0
    back = part == 2
    x = np.where(legs, 0.5 * side_x, np.where(back, 0.1 * np.round(3 * x), 0.5 * x))
    z = np.where(legs, 0.5 * side_z, np.where(back, -0.45, 0.5 * z))
    y = np.where(legs, 0.5 * y - 0.5, np.where(back, 0.6 * y + 0.6, 0.02 * y))
    means = np.stack([x, y, z], axis=1) + draw.normal(0.0, 0.01, (count, 3))
    upright = [0.01, 0.06, 0.01]
    scales = np.where((legs | back)[:, None], upright, [0.03, 0.008, 0.03])
    return replace(
        random_gaussians(count, seed=5),
        means=torch.from_numpy(means).float(),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.from_numpy(scales).float().log(),
        logit_opacities=torch.full((count,), 2.0),
    )


def _quat_of(rotation: Tensor) -> Tensor:
    """Return the quaternion wxyz of a rotation matrix of a quarter or half turn. [3,3] -> [4]"""
    w = 0.5 * math.sqrt(max(0.0, 1 + float(rotation.trace())))
    xyz = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    if w > 0.1:
        return torch.cat([torch.tensor([w]), xyz / (4 * w)])
    axis = (rotation + torch.eye(3))[:, int(rotation.diagonal().argmax())]
    return torch.cat([torch.zeros(1), axis / axis.norm()])


def turned(scene: Gaussians, rotation: Tensor) -> Gaussians:
    """Return the scene rotated about the origin, including its Gaussians."""
    w, x, y, z = _quat_of(rotation)
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return replace(scene, means=scene.means @ rotation.T, quats=normalize_quats(scene.quats) @ left.T)


def upright_turn(up: Tensor) -> Tensor:
    """Return the quarter turns that bring y to an axis. [3] -> [3,3]"""
    second = torch.eye(3)[(int(up.abs().argmax()) + 1) % 3]
    # y -> up, z -> second, x -> their cross product
    return torch.stack([torch.linalg.cross(up, second), up, second], dim=1)
