"""Datasets of nerfstudio: transforms.json, dataparser_transforms.json, and scenes in its frame."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians


def write_frames(path: Path, cameras: Sequence[Camera], **fields: Any) -> Path:
    """Write the transforms.json of some cameras."""
    frames = []
    for camera in cameras:
        pose = torch.linalg.inv(camera.viewmat.double())
        pose[:, 1:3] *= -1
        frames.append({"file_path": f"images/{camera.name}.png", "transform_matrix": pose.tolist()})
    first = cameras[0]
    shared = {"w": first.width, "h": first.height, "fl_x": float(first.K[0, 0]), "frames": frames}
    path.write_text(json.dumps(shared | fields))
    return path


def write_transforms(folder: Path, way: Tensor, scale: float) -> None:
    """Write the dataparser_transforms.json of a similarity: `way` [4,4] first, then the scale."""
    content = {"transform": way[:3].tolist(), "scale": scale}
    (folder / "dataparser_transforms.json").write_text(json.dumps(content))


def move_scene(scene: Gaussians, way: Tensor, scale: float) -> Gaussians:
    """Return the scene after a rigid transform [4,4] and then a scale."""
    centers = scene.means.double() @ way[:3, :3].T + way[:3, 3]
    return replace(scene, means=(scale * centers).float(), log_scales=scene.log_scales + math.log(scale))
