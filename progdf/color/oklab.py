"""OKLab, in which equal steps look equal (Ottosson 2020, https://bottosson.github.io/posts/oklab/).

Its polar form, OKLCh, has hue, chroma and lightness: scaling the lightness there is scaling the light.
"""

from __future__ import annotations

import torch
from torch import Tensor

_LMS_FROM_LINEAR = (
    (0.4122214708, 0.5363325363, 0.0514459929),
    (0.2119034982, 0.6806995451, 0.1073969566),
    (0.0883024619, 0.2817188376, 0.6299787005),
)
_LAB_FROM_LMS = (
    (0.2104542553, 0.7936177850, -0.0040720468),
    (1.9779984951, -2.4285922050, 0.4505937099),
    (0.0259040371, 0.7827717662, -0.8086757660),
)
_GAMUT_SLACK = 1e-3  # less than a third of an 8-bit step


def srgb_to_oklab(rgb: Tensor) -> Tensor:
    """Lightness 0..1 and the two opponent axes a, b of sRGB colors. [...,3] -> [...,3]"""
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
    lms = linear @ rgb.new_tensor(_LMS_FROM_LINEAR).T
    return (lms.sign() * lms.abs() ** (1 / 3)) @ rgb.new_tensor(_LAB_FROM_LMS).T


def oklab_to_srgb(lab: Tensor) -> Tensor:
    """The inverse of `srgb_to_oklab`; colors that sRGB cannot show leave 0..1. [...,3] -> [...,3]"""
    lms = (lab @ torch.linalg.inv(lab.new_tensor(_LAB_FROM_LMS)).T) ** 3
    linear = lms @ torch.linalg.inv(lab.new_tensor(_LMS_FROM_LINEAR)).T
    return torch.where(
        linear <= 0.0031308, linear * 12.92, 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    )


def fit_gamut(lab: Tensor) -> Tensor:
    """sRGB of OKLab colors; chroma that sRGB cannot show is reduced, lightness and hue stay. [...,3]"""
    rgb = oklab_to_srgb(lab)
    outside = (rgb - 0.5).abs().amax(dim=-1) > 0.5 + _GAMUT_SLACK
    if bool(outside.any()):
        beyond = lab[outside]
        low, high = torch.zeros_like(beyond[:, :1]), torch.ones_like(beyond[:, :1])
        for _ in range(10):  # to a thousandth of the chroma
            middle = 0.5 * (low + high)
            tried = oklab_to_srgb(torch.cat([beyond[:, :1], middle * beyond[:, 1:]], dim=1))
            fits = (tried - 0.5).abs().amax(dim=1, keepdim=True) <= 0.5 + _GAMUT_SLACK
            low, high = torch.where(fits, middle, low), torch.where(fits, high, middle)
        rgb[outside] = oklab_to_srgb(torch.cat([beyond[:, :1], low * beyond[:, 1:]], dim=1))
    return rgb.clamp(0, 1)


def hue_of(lab: Tensor) -> Tensor:
    """Radians, −pi..pi. [...,3] -> [...]"""
    return torch.atan2(lab[..., 2], lab[..., 1])
