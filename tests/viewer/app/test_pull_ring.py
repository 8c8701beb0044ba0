"""The ring of a pull lies on the surface, at the radius of the influence."""

from __future__ import annotations

import numpy as np
import torch

from progdf.camera import Camera
from progdf.painting.projection import ViewSurface
from viewer.app.pull.ring import surface_ring
from viewer.render.highlight import PULLED_TINT, Highlight, highlight_colors
from viewer.state.transient import PullInfluence

SIZE = 200
DISTANCE = 4.0


def sphere_view(hole: bool = False) -> ViewSurface:
    """Return the surface of a unit sphere in front of a camera at the origin, with a hole near its middle."""
    K = torch.tensor([[SIZE, 0.0, SIZE / 2], [0.0, SIZE, SIZE / 2], [0.0, 0.0, 1.0]])
    camera = Camera(torch.eye(4), K, SIZE, SIZE)
    at = (np.arange(SIZE) + 0.5 - SIZE / 2) / SIZE
    rays = np.stack([*np.meshgrid(at, at), np.ones((SIZE, SIZE))], axis=2)
    square = (rays**2).sum(axis=2)
    discriminant = DISTANCE**2 - square * (DISTANCE**2 - 1.0)
    with np.errstate(invalid="ignore"):
        depth = np.where(discriminant >= 0.0, (DISTANCE - np.sqrt(discriminant)) / square, np.inf)
    if hole:
        depth[SIZE // 2, SIZE // 2 + 3] = np.inf
    ones = np.ones_like(depth, dtype=np.float32)
    return ViewSurface(camera, depth.astype(np.float32), ones, ones)


def test_ring_is_on_the_surface_at_the_radius() -> None:
    front = (0.0, 0.0, DISTANCE - 1.0)
    for hole in (False, True):
        for outermost in (False, True):
            ring = np.array(surface_ring(front, 0.6, sphere_view(hole), outermost))
            assert len(ring) >= 90
            from_center = np.linalg.norm(ring - np.array([0.0, 0.0, DISTANCE]), axis=1)
            assert np.abs(from_center - 1.0).max() < 0.02
            assert np.abs(np.linalg.norm(ring - np.array(front), axis=1) - 0.6).max() < 0.02


def test_ring_ends_at_the_edge_of_the_surface() -> None:
    side = np.array([0.6, 0.0, DISTANCE - 0.8])
    ring = np.array(surface_ring((0.6, 0.0, DISTANCE - 0.8), 0.9, sphere_view(), outermost=False))
    away = np.linalg.norm(ring - side, axis=1)
    assert away.max() < 0.92
    assert away.min() < 0.7, "the edge is nearer on the right"
    assert not surface_ring((0.0, 0.0, -1.0), 0.5, sphere_view(), outermost=False)


def test_tint_follows_the_influence() -> None:
    influence = PullInfluence(np.array([1, 3, 4]), np.array([1.0, 0.5, 0.0]))
    colors = highlight_colors(Highlight(pulled=influence), (), 6)
    assert colors[:, 3].tolist() == [0, PULLED_TINT, 0, round(PULLED_TINT / 2), 0, 0]
