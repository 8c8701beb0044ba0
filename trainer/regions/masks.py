"""Masks made elsewhere, one picture a camera: white is the region, black is not, gray is in between.

    DIR/NAME.png        named as the run names the camera's view (see RUN/views/original)
    DIR/cameras.json    the cameras, where the masks bring their own; else those of --cameras

Any size with the camera's proportions will do. Transparent pixels lie outside the region. A camera without a
mask tells nothing; a black mask says that the view does not show the region.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from progdf.camera import Camera, undistort
from progdf.errors import ProgdfError
from progdf.io.images import flatten_onto, open_picture
from trainer.editors.pictures import SUFFIXES


def read_masks(folder: Path, cameras: Sequence[Camera], bent: bool = False) -> list[Tensor | None]:
    """The mask of every camera, scaled to its size, [H,W] float32 0..1 each; None where there is none.

    Args:
        folder: see the module's head
        cameras: with the names of their views
        bent: the masks were drawn over photographs, which the cameras' lenses have bent: straighten them

    Raises:
        ProgdfError: no such folder, not one mask in it, or one that is broken or of other proportions.
    """
    if not folder.is_dir():
        raise ProgdfError(f"{folder} is not a folder; give the one that holds a mask for each view")
    files = [_file(folder, camera) for camera in cameras]
    if not any(files):
        raise ProgdfError(
            f"{folder} has no mask for any of the {len(cameras)} cameras; "
            f"name each as its view, as {cameras[0].name}.png"
        )
    found = zip(files, cameras, strict=True)
    return [None if file is None else _mask(file, camera, bent) for file, camera in found]


def _file(folder: Path, camera: Camera) -> Path | None:
    paths = (folder / f"{camera.name}{suffix}" for suffix in SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def _mask(path: Path, camera: Camera, bent: bool) -> Tensor:
    size = (camera.width, camera.height)
    gray = flatten_onto(open_picture(path, size, calibrated=bent), "black").convert("L")
    if gray.size != size:
        gray = gray.resize(size, Image.Resampling.BOX)
    mask = torch.from_numpy(np.asarray(gray, dtype=np.float32) / 255.0)
    if bent and camera.lens:
        return undistort(mask[..., None].expand(-1, -1, 3), camera.K, camera.lens)[0][..., 0]
    return mask
