"""Hard cases rendered by any engine, with their gradients, and the difference of two renderings."""

from __future__ import annotations

import functools
import importlib.util
from dataclasses import dataclass, fields, replace

import pytest
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import ENGINES, ActivatedGaussians, Crop, RasterInfo, Rendering, activate, render
from progdf.rasterize.engines import engine_device
from tests.helpers.draws import Draws
from tests.helpers.scenes import HardCase, hard_cases, orbit_camera, random_gaussians

INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmat", "K", "background")
CASES = hard_cases() | {
    # used only in training; a screen shows whole pictures
    "samples of a larger picture": HardCase(
        random_gaussians(200, seed=4, scale=0.01), replace(orbit_camera(), sampling=3.0)
    )
}

NEEDS_WARP = pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="warp-lang is not installed")
EVERY = [pytest.param(name, marks=NEEDS_WARP if name == "warp" else ()) for name in ENGINES]
"""All engines."""
FAST = EVERY[1:]
"""All engines except the reference."""


@dataclass(frozen=True)
class Drawn:
    """A rendering, and the gradients of a fixed random weighting of it by input name."""

    image: Tensor
    transmittance: Tensor
    info: RasterInfo
    gradients: dict[str, Tensor]


def draw(
    gaussians: Gaussians,
    camera: Camera,
    engine: str,
    crop: Crop | None = None,
) -> Drawn:
    """Render on the engine's device, a GPU if there is one and the engine is warp. Results are on the CPU."""
    dtype = torch.float64 if engine == "reference" else torch.float32
    device = engine_device(engine)
    background = torch.tensor([0.2, 0.4, 0.6])
    inputs = (*activate(gaussians).tensors, camera.viewmat, camera.K, background)
    leaves = {
        name: tensor.to(device, dtype).clone().requires_grad_()
        for name, tensor in zip(INPUTS, inputs, strict=True)
    }
    image, transmittance, info = render_leaves(leaves, camera, gaussians.antialiased, engine, crop)
    weights = Draws(11).normal(camera.height, camera.width, 4).to(device, dtype)
    if crop is not None:
        weights = weights[crop[1] : crop[3], crop[0] : crop[2]]
    ((image * weights[..., :3]).sum() + (transmittance * weights[..., 3]).sum()).backward()
    gradients = {name: leaf.grad.cpu() for name, leaf in leaves.items() if leaf.grad is not None}
    info_on_cpu = RasterInfo(*(getattr(info, field.name).cpu() for field in fields(info)))
    return Drawn(image.detach().cpu(), transmittance.detach().cpu(), info_on_cpu, gradients)


def render_leaves(
    leaves: dict[str, Tensor], camera: Camera, antialiased: bool, engine: str, crop: Crop | None = None
) -> Rendering:
    """Render with each of `INPUTS` in place of the scene's and the camera's own."""
    activated = ActivatedGaussians(*(leaves[name] for name in INPUTS[:5]), antialiased)
    placed = replace(camera, viewmat=leaves["viewmat"], K=leaves["K"])
    return render(activated, placed, leaves["background"], crop=crop, engine=engine)


@functools.cache
def drawn_case(name: str, engine: str) -> Drawn:
    case = CASES[name]
    return draw(case.gaussians, case.camera, engine)


def image_error(found: Drawn, expected: Drawn) -> float:
    """Return the largest difference of a color, over the brightest color if that is above 1."""
    if not expected.image.numel():
        return 0.0
    difference = (found.image - expected.image).abs().max()
    return float(difference / expected.image.abs().max().clamp_min(1.0))


def relative_errors(found: Drawn, expected: Drawn) -> dict[str, float]:
    """Return the largest gradient error over the largest gradient, per input.

    Gradients below 1e-6 count as zero.
    """
    errors = {}
    for name, reference in expected.gradients.items():
        difference = (found.gradients[name] - reference).abs()
        errors[name] = (
            float(difference.max() / reference.abs().max().clamp_min(1e-6)) if len(reference) else 0.0
        )
    return errors
