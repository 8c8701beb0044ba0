"""Builders of .ply files, written by plyfile, the reference implementation of the format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from progdf.gaussians import ATTRIBUTES, Gaussians
from tests.helpers.draws import Draws
from tests.helpers.scenes import random_gaussians

COUNT = 50


def scene_of(sh_degree: int = 3, count: int = COUNT, seed: int = 1) -> Gaussians:
    """Return a scene with unit quaternions, as read from a file."""
    scene = random_gaussians(count, seed=seed)
    higher = Draws(seed).normal(count, (sh_degree + 1) ** 2 - 1, 3)
    return replace(scene, quats=scene.unit_quats, shN=higher)


def assert_same(found: Gaussians, expected: Gaussians) -> None:
    for name in ATTRIBUTES:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def table_of(scene: Gaussians) -> dict[str, np.ndarray]:
    """Return the scene as the file's columns, in the order of the original 3DGS code."""
    rest = scene.shN.transpose(1, 2).flatten(1)
    columns: dict[str, Tensor] = dict(zip("xyz", scene.means.unbind(1), strict=True))
    columns |= {name: torch.zeros(len(scene)) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{i}": scene.sh0[:, i] for i in range(3)}
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    columns["opacity"] = scene.logit_opacities
    columns |= {f"scale_{i}": scene.log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": scene.quats[:, i] for i in range(4)}
    return {name: values.numpy() for name, values in columns.items()}


def moved_columns(scene: Gaussians, by: Sequence[float]) -> dict[str, np.ndarray]:
    """Return the columns of the scene moved in the world, with x, y and z as doubles."""
    places = {name: scene.means[:, i].double().numpy() + by[i] for i, name in enumerate("xyz")}
    return table_of(scene) | places


def write(
    path: Path,
    columns: dict[str, np.ndarray],
    text: bool = False,
    byte_order: str = "<",
    before: Sequence[PlyElement] = (),
    after: Sequence[PlyElement] = (),
) -> Path:
    """Write a .ply with plyfile."""
    rows = np.empty(len(columns["x"]), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    vertex = PlyElement.describe(rows, "vertex")
    PlyData([*before, vertex, *after], text=text, byte_order=byte_order).write(str(path))
    return path


def camera_element() -> PlyElement:
    return PlyElement.describe(np.array([(1.0, 2.0)], [("fx", "f4"), ("fy", "f4")]), "camera")


def face_element() -> PlyElement:
    faces = np.empty(2, [("vertex_indices", "i4", (3,)), ("flag", "u1")])
    faces["vertex_indices"] = [[0, 1, 2], [2, 1, 0]]
    faces["flag"] = 7
    return PlyElement.describe(faces, "face")


def as_type(code: str, names: str = "") -> Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]:
    return lambda columns: {k: v.astype(code) if k in (names or k) else v for k, v in columns.items()}


def with_extra(name: str, code: str, place: int) -> Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]:
    def add(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        items = list(columns.items())
        items.insert(place, (name, np.arange(len(columns["x"])).astype(code)))
        return dict(items)

    return add


def sharp_elements(count: int, **changes: Any) -> list[PlyElement]:
    """Return the elements that Apple's SHARP writes after its vertices, for a photo of 640 by 480 pixels.

    `changes` replaces numbers by the name of their element. `renamed` names an element whose property is
    renamed.
    """
    renamed = changes.pop("renamed", "")
    contents: dict[str, tuple[Any, str]] = {
        "extrinsic": (np.eye(4).ravel(), "f4"),
        "intrinsic": ([512.0, 0.0, 320.0, 0.0, 512.0, 240.0, 0.0, 0.0, 1.0], "f4"),
        "image_size": ([640, 480], "u4"),
        "frame": ([1, count], "i4"),
        "disparity": ([0.3, 0.4], "f4"),
        "color_space": ([0], "u1"),
        "version": ([1, 5, 0], "u1"),
    }
    elements = []
    for name, (numbers, code) in contents.items():
        values = np.asarray(changes.get(name, numbers))
        table = np.empty(len(values), [("other" if name == renamed else name, code)])
        table[table.dtype.names[0]] = values.astype(code)
        elements.append(PlyElement.describe(table, name))
    return elements
