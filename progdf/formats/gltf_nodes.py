"""Node hierarchy of a glTF file: the visible meshes of its scene and their transforms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.file_rules import damage_error, unsupported_error
from progdf.quaternions import matrix_quats, rotation_matrices
from progdf.system.equality import equal_fields
from progdf.terminal import escape_text

from .gltf_file import REFUSED_EXTENSIONS, GltfFile, Node, entry

VISIBILITY = "KHR_node_visibility"

SIMILARITY_TOLERANCE = 1e-4  # relative deviation of a node's three scales, and of its axes from right angles


@dataclass(frozen=True)
class Placement:
    """Visible instance of a mesh."""

    __eq__ = equal_fields

    mesh: int
    node: int | None  # None: the file has no nodes
    matrix: NDArray[np.float64]  # mesh to world. [4,4]


def find_placements(file: GltfFile) -> list[Placement]:
    """Return the visible meshes of the file's scene, in the order of its nodes.

    Raises:
        ProgdfError: a node is its own ancestor or has two parents, or its transform is invalid.
    """
    tables = file.tables
    if not tables.nodes:
        return [Placement(mesh, None, np.eye(4)) for mesh in range(len(tables.meshes))]
    if tables.scenes:
        roots = entry(file, tables.scenes, tables.scene or 0, "scenes").nodes
    else:
        children = {child for node in tables.nodes for child in node.children}
        roots = [index for index in range(len(tables.nodes)) if index not in children]
    found: list[Placement] = []
    visited: set[int] = set()
    pending = [(root, np.eye(4)) for root in reversed(roots)]
    while pending:
        index, parent = pending.pop()
        node = entry(file, tables.nodes, index, "nodes")
        if index in visited:
            raise damage_error(file.path, f"{_node_name(file, index)} has two parents")
        visited.add(index)
        visibility = node.extensions.get(VISIBILITY)
        if isinstance(visibility, dict) and visibility.get("visible") is False:
            continue
        matrix = parent @ _local_matrix(file, index, node)
        if node.mesh is not None:
            found.append(Placement(node.mesh, index, matrix))
        pending += [(child, matrix) for child in reversed(node.children)]
    return found


def _local_matrix(file: GltfFile, index: int, node: Node) -> NDArray[np.float64]:
    """Return the transform of a node relative to its parent. [4,4]"""
    parts = (node.translation, node.rotation, node.scale)
    if node.matrix is not None:
        if any(part is not None for part in parts):
            raise damage_error(
                file.path, f"{_node_name(file, index)} has a matrix and a translation, rotation or scale"
            )
        return np.array(node.matrix).reshape(4, 4).T
    matrix = np.eye(4)
    if node.rotation is not None:
        x, y, z, w = node.rotation
        length = float(np.linalg.norm(node.rotation))
        if not 0.9 < length < 1.1:
            raise damage_error(
                file.path, f"{_node_name(file, index)} has a rotation of length {length:.3g}, not 1"
            )
        matrix[:3, :3] = _rotation_matrix(np.array([w, x, y, z]) / length)
    if node.scale is not None:
        matrix[:3, :3] *= np.array(node.scale)
    if node.translation is not None:
        matrix[:3, 3] = node.translation
    return matrix


def _rotation_matrix(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix of a unit quaternion wxyz. [4] -> [3,3]"""
    return rotation_matrices(torch.from_numpy(quat)[None])[0].numpy()


def placement_similarity(file: GltfFile, placement: Placement) -> tuple[Tensor, float]:
    """Return the rotation (unit quaternion wxyz [1,4]) and the scale of a mesh with Gaussians.

    Raises:
        ProgdfError: its nodes mirror, shear or scale it unevenly, or have a skin or an unsupported extension.
    """
    if placement.node is not None:
        _check_node(file, placement.node)
    similarity = _similarity(placement.matrix)
    if similarity is None:
        raise _shape_error(file, placement)
    return similarity


def _similarity(matrix: NDArray[np.float64]) -> tuple[Tensor, float] | None:
    """Return the rotation (unit quaternion wxyz [1,4]) and the scale of a matrix; None if no similarity."""
    axes = matrix[:3, :3]
    with np.errstate(all="ignore"):
        lengths = np.linalg.norm(axes, axis=0)
        factor = float(lengths.mean())
        if not (np.isfinite(matrix).all() and 0.0 < factor < np.inf):
            return None
        unit = axes / factor
        error = np.abs(unit.T @ unit - np.eye(3)).max()
    if not error <= SIMILARITY_TOLERANCE or np.linalg.det(unit) < 0:
        return None
    return matrix_quats(torch.from_numpy(unit)[None]), factor


def _shape_error(file: GltfFile, placement: Placement) -> ProgdfError:
    """Return the error for a sheared, mirrored or unevenly scaled mesh. It names the node at fault."""
    tables = file.tables
    parents = {child: index for index, node in enumerate(tables.nodes) for child in node.children}
    chain: list[int] = []
    index = placement.node
    while index is not None:
        chain.append(index)
        index = parents.get(index)
    faulty_node = chain[0]
    matrix = placement.matrix
    for index in reversed(chain):
        local = _local_matrix(file, index, tables.nodes[index])
        if _similarity(local) is None:
            faulty_node = index
            matrix = local
            break
    with np.errstate(all="ignore"):
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
        is_even = np.isfinite(lengths).all() and lengths.min() > 0 and np.ptp(lengths) <= 1e-3 * lengths.max()
    fault = "mirrors or shears" if is_even else "scales unevenly"
    return unsupported_error(
        file.path,
        f"{_node_name(file, faulty_node)}, which {fault} Gaussians",
        "apply that transform to the Gaussians, or give the node one scale for x, y and z",
    )


def _check_node(file: GltfFile, index: int) -> None:
    """Raise ProgdfError if a node has a skin or an unsupported extension that moves its mesh."""
    node = file.tables.nodes[index]
    if node.skin is not None:
        remedy = "export it without the skeleton"
        raise unsupported_error(file.path, f"the skin of {_node_name(file, index)}", remedy)
    for name, remedy in REFUSED_EXTENSIONS.items():
        if name in node.extensions:
            raise unsupported_error(file.path, f"{name} in {_node_name(file, index)}", remedy)


def _node_name(file: GltfFile, index: int) -> str:
    name = escape_text(file.tables.nodes[index].name)[:40]
    return f"nodes[{index}]" + (f" '{name}'" if name else "")
