"""The camera files of other programs, as tables to write."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from progdf.camera import Camera
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.scenes import ball


def some_cameras() -> list[Camera]:
    return orbit_rig(ball(), 4, 320, 200, fov_y=0.7, up=torch.tensor([0.2, -1.0, 0.1]))


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def nerfstudio(cameras: list[Camera], **changes: object) -> dict[str, Any]:
    """transforms.json as nerfstudio writes it; a change to None removes the key."""
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
