"""The rows of a .ply element, in blocks that stay in the cache, whatever the types and the byte order."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from progdf.errors import ProgdfError

from .ply_header import Element, PlyHeader

Floats = npt.NDArray[np.float32]
Store = Callable[[int, Floats, dict[str, int]], None]
"""Takes (first row, block [B,P] float32, column of each property); the block is reused afterwards."""

BLOCK_ROWS = 4096
"""1 MB of SH3 rows: read, cast and taken apart while it is in the second-level cache."""

_LONGEST_NUMBER = 400
"""Characters of an ascii number: %f writes the largest double in 309 digits and a few decimals."""

_MOST_LISTS = 1_000_000
"""Values of list rows before the vertices that are stepped over, one by one, in about a second."""


def read_blocks(
    path: str | os.PathLike[str],
    header: PlyHeader,
    element: Element,
    wanted: tuple[str, ...],
    store: Store,
    threads: int = 1,
) -> int:
    """Read the rows of one element and hand them to `store`, block by block, in any order.

    Args:
        wanted: scalar properties that `store` needs
        store: called from up to `threads` threads at once, for different rows

    Returns:
        Bytes after the last row of the file's last element, 0 where lists follow.

    Raises:
        ProgdfError: a row is not what the header says.
    """
    name = os.fspath(path)
    if element.has_lists:
        raise ProgdfError(f"{name} has a list among its vertex properties; export it as a plain 3DGS .ply")
    place = header.elements.index(element)
    with Path(path).open("rb") as file:
        file.seek(header.length)
        for before in header.elements[:place]:
            _skip(name, file, header, before)
        if header.format == "ascii":
            _read_ascii(name, file, element, wanted, store)
        else:
            start = file.tell()
            if start + element.count * element.least_row_bytes > header.file_size:
                raise _truncation_error(name, element)
            _read_fixed(path, header, element, start, wanted, store, threads)
            file.seek(element.count * element.least_row_bytes, os.SEEK_CUR)
        following = header.elements[place + 1 :]
        if any(after.has_lists for after in following):
            return 0
        for after in following:
            _skip(name, file, header, after)
        return len(file.read().strip()) if header.format == "ascii" else header.file_size - file.tell()


def _skip(name: str, file: BinaryIO, header: PlyHeader, element: Element) -> None:
    """Move behind an element that is not wanted."""
    if header.format == "ascii":
        if sum(1 for _ in itertools.islice(file, element.count)) < element.count:
            raise _truncation_error(name, element)
    elif not element.has_lists:
        file.seek(element.count * element.least_row_bytes, os.SEEK_CUR)
    elif element.count * len(element.properties) > _MOST_LISTS:
        raise ProgdfError(
            f"{name} has {element.count} rows of lists, '{element.name}', before its vertices; "
            "export it with the vertices first"
        )
    else:
        lists = [(np.dtype(header.byte_order + (c.count_type or c.type)), c) for c in element.properties]
        for _ in range(element.count):
            for kind, column in lists:
                if column.count_type is None:
                    file.seek(kind.itemsize, os.SEEK_CUR)
                    continue
                found = file.read(kind.itemsize)
                length = int(np.frombuffer(found, kind)[0]) if len(found) == kind.itemsize else -1
                if length < 0:
                    raise _truncation_error(name, element)
                file.seek(length * int(column.type[1]), os.SEEK_CUR)


def _truncation_error(name: str, element: Element) -> ProgdfError:
    return ProgdfError(
        f"{name} ends within element '{element.name}'; it is truncated or damaged: copy or export it again"
    )


def _read_fixed(
    path: str | os.PathLike[str],
    header: PlyHeader,
    element: Element,
    start: int,
    wanted: tuple[str, ...],
    store: Store,
    threads: int,
) -> None:
    row = np.dtype([(column.name, header.byte_order + column.type) for column in element.properties])
    plain = all(
        row[column] == np.dtype("<f4") for column in element.names
    )  # a block is then a matrix as it is
    where = {name: i for i, name in enumerate(element.names if plain else wanted)}

    def read(first: int, last: int) -> None:
        buffer = np.empty(min(BLOCK_ROWS, last - first), row)
        block = np.empty((len(buffer), len(wanted)), np.float32)
        with Path(path).open("rb", buffering=0) as file:
            file.seek(start + first * row.itemsize)
            for at in range(first, last, BLOCK_ROWS):
                rows = buffer[: min(BLOCK_ROWS, last - at)]
                _fill(os.fspath(path), file, rows)
                if plain:
                    store(at, rows.view(np.float32).reshape(len(rows), -1), where)
                else:
                    _cast(rows, block[: len(rows)], wanted)
                    store(at, block[: len(rows)], where)

    share = -(-element.count // threads)
    edges = [(first, min(first + share, element.count)) for first in range(0, element.count, share)]
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(read, first, last) for first, last in edges]:
            done.result()


def _fill(name: str, file: BinaryIO, rows: npt.NDArray[np.void]) -> None:
    view = memoryview(rows.view(np.uint8).reshape(-1))  # type: ignore[arg-type]
    done = 0
    while done < len(view):
        got = file.readinto(view[done:])  # type: ignore[attr-defined]
        if not got:
            raise ProgdfError(
                f"{name} shrank while it was being read; wait until it has been written and try again"
            )
        done += got


def _cast(rows: npt.NDArray[np.void], block: Floats, wanted: tuple[str, ...]) -> None:
    with np.errstate(over="ignore", invalid="ignore"):  # a double beyond float32 becomes ±inf and is repaired
        for i, name in enumerate(wanted):
            block[:, i] = rows[name]


def _read_ascii(name: str, file: BinaryIO, element: Element, wanted: tuple[str, ...], store: Store) -> None:
    where = {column: i for i, column in enumerate(wanted)}
    places = [element.names.index(column) for column in wanted]
    longest = (_LONGEST_NUMBER + 2) * len(element.properties)
    for first in range(0, element.count, BLOCK_ROWS):
        rows = min(BLOCK_ROWS, element.count - first)
        words = [file.readline(longest).split() for _ in range(rows)]
        for i in range(rows):
            found = len(words[i])
            if found != len(element.properties):
                raise ProgdfError(
                    f"{name} has {found} numbers in row {first + i}, its header names "
                    f"{len(element.properties)}; it is truncated or damaged: copy or export it again"
                )
        try:
            table = np.array([[line[p] for p in places] for line in words]).astype(np.float64)
        except ValueError:
            raise ProgdfError(
                f"{name} has something that is not a number between rows {first} and {first + rows - 1}; "
                f"it is damaged: copy or export it again"
            ) from None
        with np.errstate(over="ignore"):
            store(first, table.astype(np.float32), where)
