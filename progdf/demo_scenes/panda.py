"""The bear's picture as a hand changes it: a panda's coat, painted over the render."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.color.edits import parse_color, recolor_fully, typical_color

from .paint import step

_CREAM, _CHARCOAL = "#ece6dc", "#3a3638"
_DARK = 0.36  # fur is brighter; nose and mouth are not

# Where in space, how wide and tall in world units, and how far it leans, in radians.
_PATCHES = (((0.185, 1.53, 0.44), (0.125, 0.165), 0.5), ((-0.185, 1.53, 0.44), (0.085, 0.157), -0.35))
_EYES = (((0.17, 1.545, 0.46), (0.051, 0.058), 0.0), ((-0.17, 1.545, 0.46), (0.045, 0.058), 0.0))
_NOSE_AND_MOUTH = (((0.0, 1.44, 0.60), (0.118, 0.095), 0.0), ((0.02, 1.31, 0.59), (0.118, 0.092), 0.0))


def paint_panda(picture: Tensor, camera: Camera, cover: Callable[[tuple[str, ...]], Tensor]) -> Tensor:
    """The picture with the head and body cream, the limbs, the ears and around the eyes charcoal.

    The fur's shading stays, as under a layer that a paint program multiplies.

    Args:
        picture: the bear. [H,W,3] sRGB
        camera: that it was rendered from
        cover: names of parts -> their share of each pixel, 0..1. [H,W]
    """
    head = cover(("head",))
    patches = torch.maximum(*(_ellipse(camera, *patch) for patch in _PATCHES)) * head
    eyes = torch.maximum(*(_ellipse(camera, *eye) for eye in _EYES))
    features = torch.maximum(*(_ellipse(camera, *feature) for feature in _NOSE_AND_MOUTH))
    painted = _wash(picture, cover(("head", "body")), _CREAM)
    painted = _wash(painted, cover(("ears", "arms", "legs")), _CHARCOAL)
    painted = _wash(painted, patches, _CHARCOAL)
    dark = 1 - step(picture.mean(dim=2), _DARK - 0.12, _DARK)
    kept = torch.maximum(eyes, features * dark) * head
    return torch.lerp(painted, picture, kept[..., None])


def _wash(picture: Tensor, share: Tensor, color: str) -> Tensor:
    """Another color where the share is 1. [H,W,3], [H,W] 0..1 -> [H,W,3]"""
    share = (1.5 * share).clamp(0, 1)  # else the old color would shine out at soft edges
    washed = recolor_fully(picture, parse_color(color), typical_color(picture, share))
    return torch.lerp(picture, washed, share[..., None])


def _ellipse(
    camera: Camera, center: tuple[float, float, float], radii: tuple[float, float], turn: float
) -> Tensor:
    """A leaning ellipse with a soft edge about where a point in space shows. [H,W] 0..1"""
    x, y, depth = camera.viewmat[:3, :3] @ torch.tensor(center) + camera.viewmat[:3, 3]
    at = camera.K @ torch.stack([x / depth, y / depth, torch.ones(())])
    rows, columns = torch.meshgrid(
        torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
    )
    right, down = (columns - at[0]) * depth / camera.K[0, 0], (rows - at[1]) * depth / camera.K[1, 1]
    along = (right * math.cos(turn) + down * math.sin(turn)) / radii[0]
    across = (down * math.cos(turn) - right * math.sin(turn)) / radii[1]
    return ((1 - torch.hypot(along, across)) / 0.12 + 0.5).clamp(0, 1)
