"""Reader of streamed SOG scenes (SuperSplat, splat-transform): a tree of boxes over SOG files, its tiles.

The index, lod-meta.json, lies beside a folder for each tile. A leaf of the tree names, for each level of
detail, rows of one tile. Level 0 is the finest. The scene is made of the finest level of each leaf, and of
the surroundings, which have no levels. Tiles are read one by one, so that only one is decoded at a time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import msgspec
import numpy as np

from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians, from_arrays
from progdf.io.atomic import read_file
from progdf.io.file_rules import check_fields, damage_error, unsupported_error
from progdf.io.json_values import convert_json, decode_json
from progdf.terminal import group_digits

from .sog import CONVERT, META, SogScene, read_sog

INDEX = "lod-meta.json"
"""File name of the index. The path of this file, or its folder, stands for the scene."""

_MAX_INDEX_BYTES = (
    16 << 20
)  # an index of 14 million Gaussians has 0.3 MB; parsed JSON takes 30 times its size
_KNOWN_FIELDS = ("version", "asset", "count", "counts", "lodLevels", "environment", "filenames", "tree")


class _Rows(msgspec.Struct):
    """Rows of one tile."""

    file: int  # position in `filenames`
    offset: int  # first row
    count: int  # number of rows


class _Node(msgspec.Struct):
    """Node of the tree: an inner node has children, a leaf has levels."""

    children: list[_Node] = []
    lods: dict[str, _Rows] = {}  # level → its rows


class _Index(msgspec.Struct):
    """Fields of lod-meta.json that are read."""

    lodLevels: Annotated[int, msgspec.Meta(ge=1)]
    filenames: list[str]
    tree: _Node
    environment: str | None = None
    version: int = 1


@dataclass(frozen=True)
class SogTree:
    """Scene as stored, with the facts for its report."""

    gaussians: Gaussians
    tiles: int  # number of tiles that were read
    coarser: tuple[int, ...]  # numbers of Gaussians of the coarser levels, which are not read
    ignored: tuple[str, ...]  # unused fields of the index and of the tiles
    file_bytes: int  # of the index and the tiles that were read


def is_index(path: Path, start: bytes) -> bool:
    """Return True if a file is the index of a streamed SOG scene, by its name and its first bytes."""
    return path.name.lower() == INDEX and start.lstrip()[:1] == b"{"


def read_sog_tree(path: Path) -> SogTree:
    """Return the finest level of a streamed SOG scene. Axes are those of the original .ply.

    Args:
        path: the index

    Raises:
        ProgdfError: the version is not supported, a tile is missing, or a file is damaged.
    """
    table = _read_table(path)
    try:
        index = convert_json(table, _Index)
    except ValueError as error:
        raise damage_error(path, f"in {INDEX}, {error}") from None
    if index.version != 1:
        raise unsupported_error(path, f"version {index.version} of a streamed SOG scene", CONVERT)
    ignored = dict.fromkeys(check_fields(path, table, _KNOWN_FIELDS, {}, CONVERT))
    spans, coarser = _list_spans(path, index)
    sizes = {file: sum(rows.count for rows in parts) for file, parts in spans.items()}
    surroundings = None
    if index.environment is not None:
        surroundings = read_sog(_tile(path, index.environment))
    total = sum(sizes.values()) + (0 if surroundings is None else len(surroundings.gaussians))
    if total < 1:
        raise ProgdfError(f"{path} holds 0 Gaussians; a scene needs at least one: export it again")
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    antialiased: bool | None = None
    filled = 0
    file_bytes = path.stat().st_size
    for file in sorted(spans):
        tile_path = _tile(path, index.filenames[file])
        tile = read_sog(tile_path)
        file_bytes += _tile_bytes(tile_path)
        ignored |= dict.fromkeys(tile.ignored)
        antialiased = _check_alike(tile_path, tile, antialiased, arrays)
        for rows in spans[file]:
            if rows.offset + rows.count > len(tile.gaussians):
                raise damage_error(path, f"{INDEX} names row {rows.offset + rows.count - 1} of {tile_path}")
            _copy_rows(tile.gaussians, rows, arrays, filled, total)
            filled += rows.count
    if surroundings is not None:
        tile_path = _tile(path, str(index.environment))
        file_bytes += _tile_bytes(tile_path)
        antialiased = _check_alike(tile_path, surroundings, antialiased, arrays)
        whole = _Rows(0, 0, len(surroundings.gaussians))
        _copy_rows(surroundings.gaussians, whole, arrays, filled, total)
    tiles = len(spans) + (surroundings is not None)
    return SogTree(from_arrays(arrays, bool(antialiased)), tiles, coarser, tuple(ignored), file_bytes)


def describe_levels(tree: SogTree) -> str:
    """Return the format of a scene for its report."""
    text = f"streamed .sog, the finest level in {group_digits(tree.tiles)} tiles"
    if tree.coarser:
        counts = ", ".join(group_digits(count) for count in tree.coarser)
        text += f" (coarser levels of {counts} Gaussians are not read)"
    return text


def _read_table(path: Path) -> dict[str, Any]:
    content = read_file(path, _MAX_INDEX_BYTES + 1)
    if len(content) > _MAX_INDEX_BYTES:
        raise damage_error(
            path, f"it has more than {_MAX_INDEX_BYTES >> 20} MB; usual ones have less than one"
        )
    try:
        table = decode_json(content)
    except ValueError as error:
        raise damage_error(path, f"in {INDEX}, {error}") from None
    if not isinstance(table, dict):
        raise damage_error(path, f"{INDEX} is no table")
    return table


def _leaves(node: _Node) -> Iterator[_Node]:
    """Yield the nodes that name rows, in the order of the file."""
    if node.lods:
        yield node
    for child in node.children:
        yield from _leaves(child)


def _list_spans(path: Path, index: _Index) -> tuple[dict[int, list[_Rows]], tuple[int, ...]]:
    """Return the rows of the finest level by tile, and the numbers of Gaussians of the coarser levels."""
    spans: dict[int, list[_Rows]] = {}
    counts: Counter[int] = Counter()
    for leaf in _leaves(index.tree):
        levels = {int(name): rows for name, rows in leaf.lods.items() if name.isdecimal()}
        if len(levels) < len(leaf.lods) or max(levels) >= index.lodLevels:
            raise damage_error(path, f"a leaf names a level that is not one of {index.lodLevels}")
        finest = min(levels)
        for level, rows in levels.items():
            if min(rows.offset, rows.count) < 0 or not 0 <= rows.file < len(index.filenames):
                raise damage_error(path, "a leaf names rows that no tile has")
            if level == finest:
                spans.setdefault(rows.file, []).append(rows)
            else:
                counts[level] += rows.count
    for parts in spans.values():
        parts.sort(key=lambda rows: rows.offset)
        for first, second in pairwise(parts):
            if first.offset + first.count > second.offset:
                raise damage_error(path, "two leaves name the same rows")
    return spans, tuple(counts[level] for level in sorted(counts) if counts[level])


def _tile(path: Path, name: str) -> Path:
    """Return the path of a tile's table or archive, inside the folder of the index.

    Raises:
        ProgdfError: the name leads out of the folder, or the file is missing.
    """
    parts = PurePosixPath(name).parts
    if not parts or ".." in parts or name.startswith("/") or "\\" in name or "\0" in name or ":" in name:
        raise damage_error(path, f"{INDEX} names files outside its folder ({name[:80]!r})")
    found = path.parent
    for part in parts:
        found = found / part
        if found.is_symlink():
            raise damage_error(path, f"{name[:80]} is a link")
    if not found.is_file():
        raise damage_error(path, f"{name[:80]} is missing; all its tiles are needed")
    return found


def _tile_bytes(path: Path) -> int:
    """Return the bytes of a tile: an archive, or all files beside its table."""
    if path.name.lower() != META:
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.parent.iterdir() if file.is_file())


def _check_alike(
    path: Path, tile: SogScene, antialiased: bool | None, arrays: dict[str, np.ndarray[Any, Any]]
) -> bool:
    """Return whether the tile is antialiased. Raise ProgdfError if it differs from the tiles before it."""
    functions = tile.gaussians.shN.shape[1]
    is_other = antialiased is not None and antialiased != tile.gaussians.antialiased
    if is_other or (arrays and arrays["shN"].shape[1] != functions):
        raise damage_error(path, "it differs from other tiles in SH degree or antialiasing")
    return tile.gaussians.antialiased


def _copy_rows(
    tile: Gaussians, rows: _Rows, arrays: dict[str, np.ndarray[Any, Any]], start: int, total: int
) -> None:
    """Copy rows of a tile into the arrays of the scene, which are made by the first call."""
    for name in ATTRIBUTES:
        source = getattr(tile, name).numpy()
        if name not in arrays:
            arrays[name] = np.empty((total, *source.shape[1:]), np.float32)
        arrays[name][start : start + rows.count] = source[rows.offset : rows.offset + rows.count]
