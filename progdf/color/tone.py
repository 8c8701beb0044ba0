"""Controls of a color grade: one pure function each, on OKLab colors.

Lightness is OKLab's, 0 (black) to 1 (white). Every control takes its slider value, where 0 changes nothing.
Every tone control rises strictly with the lightness and is monotone in its slider, so any sequence of them is
too. No control of light changes a hue: chroma is only scaled. White balance and color wheels add the same
chroma to every color of a lightness. `progdf.color.grade` applies the controls in order.

The names and effects are those of Lightroom Classic (basic panel, color grading) and DaVinci Resolve (lift,
gamma, gain). The formulas are ours: their programs publish none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from .oklab import smoothstep

MIDDLE_GRAY = 0.5646
"""Lightness of 18 % gray, the fixed point of contrast."""

_CAST_CHROMA = 0.1  # chroma of white under the bluest and the most amber light, as a share of its lightness
_TONE_WIDTH = 0.6  # share of the lightness range that shadows move, from black, and highlights, from white
_TONE_SHARE = 0.9  # share of the largest shift at which these two still rise with the lightness
_BUMP_SLOPE = 16.0 * math.sqrt(3.0) / 9.0  # largest slope of 16 t² (1 − t)² within 0 to 1
_END_SHIFT = 0.2  # shift of white by whites, and of black by blacks, in lightness; monotone below 1/3
_VIBRANCE_CHROMA = 0.12  # chroma at which vibrance has half of its effect
_WHEEL_CHROMA = 0.12  # chroma that a wheel adds at its rim
_WHEEL_LIGHTNESS = 0.1  # lightness that a wheel adds at 1
_PIVOT_RANGE = 0.15  # distance of the wheels' pivot from the middle at a balance of −1 or 1

WHEELS = ("shadows", "midtones", "highlights")
"""Names of the wheels, darkest first."""


class Wheel(NamedTuple):
    """Setting of one color wheel."""

    hue: float = 0.0  # OKLab hue, degrees
    amount: float = 0.0  # distance from the center, 0 to 1
    light: float = 0.0  # change of lightness, −1 to 1


def expose(lab: Tensor, stops: float) -> Tensor:
    """Scale the light by 2^stops. OKLab is homogeneous of degree 1/3 in linear light. [...,3] -> [...,3]"""
    gain: float = 2.0 ** (stops / 3)
    return lab * gain


def balance_white(ab: Tensor, lightness: Tensor, temperature: float, tint: float) -> Tensor:
    """Add a cast in proportion to the lightness.

    Args:
        ab: OKLab a and b. [...,2]
        lightness: 0 to 1. [...]
        temperature: −1 (blue) to 1 (amber)
        tint: −1 (green) to 1 (magenta)
    """
    return ab + _CAST_CHROMA * lightness[..., None] * ab.new_tensor([tint, temperature])


def contrast(lightness: Tensor, value: float) -> Tensor:
    """Raise the slope at middle gray to 2^value; black, white and middle gray stay. [...] -> [...]

    Args:
        lightness: 0 to 1
        value: −1 to 1
    """
    power = 2.0**value
    low = MIDDLE_GRAY * (lightness / MIDDLE_GRAY).clamp(0, 1).pow(power)
    high = (1 - MIDDLE_GRAY) * ((1 - lightness) / (1 - MIDDLE_GRAY)).clamp(0, 1).pow(power)
    return torch.where(lightness < MIDDLE_GRAY, low, 1 - high)


def shadows(lightness: Tensor, value: float) -> Tensor:
    """Lift (1) or deepen (−1) the lower tones; black and everything above 0.6 stay. [...] -> [...]"""
    return lightness + value * _tone_bump(lightness / _TONE_WIDTH)


def highlights(lightness: Tensor, value: float) -> Tensor:
    """Brighten (1) or recover (−1) the upper tones; white and everything below 0.4 stay. [...] -> [...]"""
    return lightness + value * _tone_bump((1.0 - lightness) / _TONE_WIDTH)


def _tone_bump(t: Tensor) -> Tensor:
    """Return a smooth bump over 0 to 1, of the largest height at which the tones stay in order."""
    inside = t.clamp(0, 1)
    return _TONE_WIDTH * _TONE_SHARE / _BUMP_SLOPE * 16.0 * inside.square() * (1.0 - inside).square()


def whites(lightness: Tensor, value: float) -> Tensor:
    """Move white by 0.2 × value, others by the cube of their lightness; above 1 clips. [...] -> [...]"""
    return lightness + _END_SHIFT * value * lightness**3


def blacks(lightness: Tensor, value: float) -> Tensor:
    """Move black by 0.2 × value, others by the cube of their darkness; below 0 clips. [...] -> [...]"""
    return lightness + _END_SHIFT * value * (1.0 - lightness) ** 3


def saturate(ab: Tensor, value: float) -> Tensor:
    """Scale the chroma by 1 + value; −1 is gray. [...,2] -> [...,2]"""
    return ab * (1.0 + value)


def vibrance(ab: Tensor, value: float) -> Tensor:
    """Scale the chroma of weak colors by up to 1 + value, of strong colors less. [...,2] -> [...,2]

    Chroma stays in order for values of −1 to 1.
    """
    squared = (ab / _VIBRANCE_CHROMA).square().sum(dim=-1, keepdim=True)
    return ab * (1.0 + value / (1.0 + squared))


def wheel_weights(lightness: Tensor, balance: float) -> Tensor:
    """Return the weights of shadows, midtones and highlights, which sum to 1. [...] -> [...,3]

    Args:
        lightness: 0 to 1
        balance: −1 (more colors are highlights) to 1 (more colors are shadows)
    """
    pivot = 0.5 + _PIVOT_RANGE * balance
    dark = 1.0 - smoothstep(lightness, 0.0, pivot)
    bright = smoothstep(lightness, pivot, 1.0)
    return torch.stack([dark, 1.0 - dark - bright, bright], dim=-1)


def turn_wheels(lab: Tensor, wheels: tuple[Wheel, Wheel, Wheel], balance: float) -> Tensor:
    """Add color and lightness to shadows, midtones and highlights. OKLab [...,3] -> [...,3]

    Args:
        lab: colors with lightness 0 to 1
        wheels: in the order of `WHEELS`
        balance: see `wheel_weights`
    """
    shifts = []
    for wheel in wheels:
        angle = math.radians(wheel.hue)
        chroma = _WHEEL_CHROMA * wheel.amount
        light = _WHEEL_LIGHTNESS * wheel.light
        shifts.append([light, chroma * math.cos(angle), chroma * math.sin(angle)])
    return lab + wheel_weights(lab[..., 0], balance) @ lab.new_tensor(shifts)
