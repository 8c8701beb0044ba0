"""Camera files of other programs as tables to write, and invalid viewmats."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.scenes import ball


def _axes(x: float, y: float, z: float, last: float = 1.0) -> Tensor:
    return torch.diag(torch.tensor([x, y, z, last]))


_SHEAR = torch.tensor(
    [[1.0, 0.1, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)

REFUSED_VIEWMATS = {
    "scaled by 1.7": (_axes(1.7, 1.7, 1.7), "scales by 1.7"),
    "scaled by 1.001": (_axes(1.001, 1.001, 1.001), "scales by 1.001"),
    "mirrored": (_axes(-1.0, 1.0, 1.0), "mirrors"),
    "turned inside out": (_axes(-1.0, -1.0, -1.0), "mirrors"),
    "stretched": (_axes(1.0, 1.7, 1.0), "stretches or shears"),
    "sheared": (_SHEAR, "stretches or shears"),
    "collapsed": (_axes(0.0, 0.0, 0.0), "stretches or shears"),
    "scaled by its last row": (_axes(1.0, 1.0, 1.0, 1.7), "has the last row"),
}
"""Factor to multiply a valid viewmat from the left, and the fault that the error names."""


def some_cameras() -> list[Camera]:
    return orbit_rig(ball(), 4, 320, 200, fov_y=0.7, up=torch.tensor([0.2, -1.0, 0.1]))


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def nerfstudio(cameras: list[Camera], **changes: object) -> dict[str, Any]:
    """Return transforms.json as nerfstudio writes it. A change to None removes the key."""
    frames = []
    for camera in cameras:
        c2w = camera.c2w.double()
        c2w[:, 1:3] *= -1
        frames.append({"file_path": f"images/{camera.name}.png", "transform_matrix": c2w.tolist()})
    K = cameras[0].K
    content: dict[str, Any] = {"camera_model": "OPENCV", "w": 320, "h": 200, "k1": 0.0, "p2": 0}
    content |= {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": 160.0, "cy": 100.0}
    content |= {"frames": frames, **changes}
    return {key: value for key, value in content.items() if value is not None}


def inria(cameras: list[Camera]) -> list[dict[str, Any]]:
    return [
        {
            "id": i,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.position.tolist(),
            "rotation": camera.c2w[:3, :3].tolist(),
            "fx": float(camera.K[0, 0]),
            "fy": float(camera.K[1, 1]),
        }
        for i, camera in enumerate(cameras)
    ]
