"""CLIP's direction along a camera path through the held-out views (Haque et al. 2023, Instruct-NeRF2NeRF).

Consistency of direction, mean over neighboring frames i and i + 1 of a path that training has not seen:

    cos( f(edited_i) − f(original_i), f(edited_i+1) − f(original_i+1) ),  f: CLIP features of unit length
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from trainer.report.clip import CLIP_MODEL, load_clip
from trainer.views.view import render_view

from .consistency import finished_scene
from .opened import OpenedRun

FRAMES = 5
"""From one held-out view to the next on the path."""


def camera_path(cameras: Sequence[Camera], frames: int = FRAMES) -> list[Camera]:
    """From each camera to the nearest that has not been passed, positions straight, rotations on the sphere.

    Args:
        cameras: at least one; the path begins at the first
        frames: from one to the next
    """
    left, route = list(cameras[1:]), [cameras[0]]
    while left:
        here = route[-1].position
        nearest = min(range(len(left)), key=lambda i: float((left[i].position - here).norm()))
        route.append(left.pop(nearest))
    path = []
    for a, b in pairwise(route):
        turns = Slerp([0.0, 1.0], Rotation.from_matrix([c.viewmat[:3, :3].double().numpy() for c in (a, b)]))
        path += [_between(a, b, turns, i / frames) for i in range(frames)]
    return [*path, route[-1]]


def clip_consistency(opened: OpenedRun) -> tuple[float | None, str]:
    """Consistency of CLIP's direction along the path, −1..1, at strength 1; or None and why not."""
    try:
        clip = load_clip(CLIP_MODEL)
    except ProgdfError as error:
        return None, str(error)
    if len(opened.setup.judging) < 2:
        return None, "there is one view alone, which is no path"
    path = camera_path([view.camera for view in opened.setup.judging])
    before, after = (
        clip.pictures([render_view(scene, camera, opened.setup.background) for camera in path])
        for scene in (opened.run.scene, finished_scene(opened))
    )
    found = neighbor_similarity(before, after)
    return found, "" if found is not None else "the edit changes nothing that CLIP sees"


def neighbor_similarity(before: Tensor, after: Tensor) -> float | None:
    """Mean cosine of the changes of neighboring frames; None where fewer than two change.

    Args:
        before, after: features of the frames, of unit length. [n,D]
    """
    change = (after - before).double()
    lengths = change.norm(dim=1)
    # features of equal pictures differ by rounding, which has a direction too
    pairs = (lengths[:-1] > 1e-6) & (lengths[1:] > 1e-6)
    if not bool(pairs.any()):
        return None
    cosines = (change[:-1] * change[1:]).sum(dim=1) / (lengths[:-1] * lengths[1:]).clamp_min(1e-30)
    return float(cosines[pairs].mean())


def _between(a: Camera, b: Camera, turns: Slerp, share: float) -> Camera:
    rotation = torch.from_numpy(turns(share).as_matrix())
    eye = torch.lerp(a.position.double(), b.position.double(), share)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    size = torch.tensor([[b.width], [b.height], [1.0]]) / torch.tensor([[a.width], [a.height], [1.0]])
    K = torch.lerp(a.K, b.K / size, share)
    return replace(a, viewmat=viewmat.float(), K=K)
