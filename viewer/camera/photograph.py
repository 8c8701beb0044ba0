"""Photograph of a training camera, and its picture in another view from the same place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from progdf.camera import Camera, undistort
from progdf.errors import ProgdfError

MAX_SIDE_PX = 2400  # longer side to which larger photographs are reduced, as no window shows more
OPAQUE = 0.999  # alpha from which a pixel is compared
OUTSIDE = (22 / 255, 24 / 255, 27 / 255)
"""Color of the view's pixels that the photograph does not show, sRGB."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """Photograph of a camera, undistorted and reduced to at most `MAX_SIDE_PX`."""

    camera: Camera  # pinhole camera of these pixels
    image: Tensor  # sRGB, 0 to 1. [H,W,3]
    visible: Tensor  # pixels that the photograph shows and that are opaque. [H,W] bool
    note: str  # its size, and every change that makes it fit the camera


def load_photograph(path: Path, camera: Camera) -> Photograph:
    """Read the photograph of a camera.

    The pixels are taken as they are stored, without the rotation of their EXIF data, as by COLMAP.

    Args:
        path: the picture
        camera: its camera, of any size

    Raises:
        ProgdfError: the file is not a picture that can be read.
    """
    try:
        with Image.open(path) as file:
            size = file.size
            file.thumbnail((MAX_SIDE_PX, MAX_SIDE_PX), Image.Resampling.LANCZOS)
            pixels = np.asarray(file.convert("RGBA"), np.float32) / 255.0
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise ProgdfError(f"{path.name} cannot be read as a photograph ({error})") from error
    image = torch.from_numpy(pixels[..., :3].copy())
    visible = torch.from_numpy(pixels[..., 3] >= OPAQUE)
    pinhole = camera.resize(image.shape[1], image.shape[0])
    notes = [f"photograph {size[0]} × {size[1]}"]
    if size != (camera.width, camera.height):
        notes.append(f"camera {camera.width} × {camera.height}")
    stretch = (size[0] / camera.width) / (size[1] / camera.height)
    if abs(stretch - 1.0) * max(size) > 1.0:
        notes.append(f"shapes differ, stretched by {max(stretch, 1.0 / stretch):.3g}")
    if camera.lens is not None:
        image, inside = undistort(image, pinhole.K, camera.lens)
        visible &= inside
        notes.append("lens undistorted")
    if not bool(pixels[..., 3].min() >= OPAQUE):
        notes.append("opaque pixels only")
    return Photograph(pinhole, image, visible, " · ".join(notes))


def in_view(photograph: Photograph, view: Camera) -> tuple[Tensor, Tensor]:
    """Return a photograph as a camera at the same place shows it.

    Args:
        photograph: the photograph
        view: camera with the same center, with any orientation, lens and size

    Returns:
        The picture, `OUTSIDE` where the photograph does not reach [H,W,3]; the pixels that it shows [H,W]
        bool.
    """
    taken = photograph.camera
    reduction = float(taken.K[0, 0] / view.K[0, 0])
    layers = torch.cat([photograph.image, photograph.visible[..., None].float()], dim=2).permute(2, 0, 1)[
        None
    ]
    if reduction > 1.0:  # every pixel of the view is the mean of several ones of the photograph
        size = [max(round(side / reduction), 1) for side in (taken.height, taken.width)]
        layers = interpolate(layers, size, mode="bilinear", antialias=True)
    turn = taken.viewmat[:3, :3].double() @ view.viewmat[:3, :3].double().T
    homography = taken.K.double() @ turn @ torch.linalg.inv(view.K.double())
    rows, columns = torch.meshgrid(
        torch.arange(view.height, dtype=torch.float64) + 0.5,
        torch.arange(view.width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    x, y, depth = (homography[i, 0] * columns + homography[i, 1] * rows + homography[i, 2] for i in range(3))
    ends = torch.tensor([taken.width, taken.height], dtype=torch.float64)
    grid = 2.0 * torch.stack([x / depth, y / depth], dim=2) / ends - 1.0
    sampled = grid_sample(layers, grid[None].float(), padding_mode="border", align_corners=False)[0]
    shown = (depth > 0.0) & (grid.abs() <= 1.0).all(dim=2) & (sampled[3] >= OPAQUE)
    picture = torch.where(shown[..., None], sampled[:3].permute(1, 2, 0), torch.tensor(OUTSIDE))
    return picture.contiguous(), shown
