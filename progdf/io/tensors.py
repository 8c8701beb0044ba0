"""Files of numbers: safetensors whose bytes depend on what is in them alone, and .npy.

The safetensors library writes several metadata in an order that differs from run to run, so all of them are
one JSON text in one key. It knows nothing of damaged numbers: a checksum may be among the metadata.
"""

from __future__ import annotations

import io
import math
import os
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save
from torch import Tensor

from progdf.errors import ProgdfError

from .atomic import atomic_write, check_regular, open_error

METADATA = "progdf"
"""The one key of a file's metadata."""

_CHECKSUM = "crc32"
_MAX_LEVELS = 1 << 30  # that a file of a megabyte could ask memory for
_TYPES = {
    torch.float64: "F64",
    torch.int64: "I64",
    torch.float32: "F32",
    torch.int32: "I32",
    torch.float16: "F16",
    torch.int16: "I16",
    torch.int8: "I8",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}


def table_of(tensors: Mapping[str, Tensor]) -> dict[str, tuple[tuple[int, ...], str]]:
    """Shape and type of each tensor, as a file's header calls them.

    Raises:
        KeyError: a tensor of another type than those above.
    """
    return {name: (tuple(tensor.shape), _TYPES[tensor.dtype]) for name, tensor in tensors.items()}


def check_tensor(name: str, tensor: Tensor, shape: Sequence[int | None], *types: torch.dtype) -> None:
    """Raises ValueError where a tensor has another shape, None standing for any number, or another type."""
    fits = len(shape) == tensor.ndim and all(
        n in (None, side) for n, side in zip(shape, tensor.shape, strict=True)
    )
    if not fits or tensor.dtype not in types:
        sides = ", ".join("any" if side is None else str(side) for side in shape)
        kinds = " or ".join(str(kind).removeprefix("torch.") for kind in types)
        kind = str(tensor.dtype).removeprefix("torch.")
        raise ValueError(f"{name} is {list(tensor.shape)} {kind}, expected [{sides}] {kinds}")


def check_ascent(name: str, numbers: Tensor) -> None:
    """Raises ValueError where numbers do not ascend from 0 to 1. [n]"""
    ends = numbers[[0, -1]].tolist() if numbers.ndim == 1 and len(numbers) > 1 else []
    if ends != [0.0, 1.0] or not bool((numbers.diff() > 0).all()):
        raise ValueError(f"{name} must ascend from 0 to 1")


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a safetensors file.

    Args:
        path: where to; see `atomic.atomic_write` for a file that is whole or absent
        tensors: by name, of the types in the table above; on the CPU
        metadata: texts by name; a checksum of everything, which `read_tensors` compares, is added

    Raises:
        KeyError: a tensor of another type.
        OSError: the place cannot be written.
    """
    metadata = {**metadata, _CHECKSUM: _checksum(metadata, tensors)}
    text = msgspec.json.encode(dict(sorted(metadata.items()))).decode()
    arrays = {name: tensor.detach().contiguous().numpy() for name, tensor in tensors.items()}
    path.write_bytes(save(arrays, {METADATA: text}))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a file and its metadata.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no safetensors file, or was damaged.
    """
    try:
        with safe_open(path, framework="pt") as opened:
            metadata = msgspec.json.decode((opened.metadata() or {})[METADATA], type=dict[str, str])
            tensors = {name: opened.get_tensor(name) for name in sorted(opened.keys())}
    except OSError:
        raise
    except KeyError:
        raise ValueError("it was not written by progdf") from None
    except Exception as error:  # the library's own, and torch's where a shape overflows
        raise ValueError(" ".join(str(error).split())) from None
    if metadata.pop(_CHECKSUM, None) != _checksum(metadata, tensors):
        raise ValueError("checksum mismatch")
    return tensors, metadata


def _checksum(metadata: Mapping[str, object], tensors: Mapping[str, Tensor]) -> str:
    sum_ = zlib.crc32(repr((sorted(metadata.items()), sorted(table_of(tensors).items()))).encode())
    for name in sorted(tensors):
        sum_ = zlib.crc32(
            tensors[name].detach().contiguous().reshape(-1).view(torch.uint8).numpy().data, sum_
        )
    return f"{sum_:08x}"


def deflate(levels: Tensor) -> Tensor:
    """Whole numbers of 8 bits by zlib, in whichever of two of its ways is shorter. -> [B] uint8

    Levels of noise compress by how often each comes, by Huffman's codes alone, or with runs of the same:
    shorter than zlib's own search for repetitions makes them, and ten times as fast
    (docs/experiments.md, Levels of a residual).
    """
    content = levels.contiguous().numpy().tobytes()

    def pack(strategy: int) -> bytes:
        packing = zlib.compressobj(strategy=strategy)
        return packing.compress(content) + packing.flush()

    packed = min(map(pack, (zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE)), key=len)
    return torch.from_numpy(np.frombuffer(packed, np.uint8).copy())


def check_levels(shape: Sequence[int]) -> int:
    """How many levels these are. Raises ValueError where a small file asks for memory without bounds."""
    if (size := math.prod(shape)) > _MAX_LEVELS:
        raise ValueError(f"{list(shape)} packed levels, more than {_MAX_LEVELS}")
    return size


def inflate(packed: Tensor, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """The inverse of `deflate`, never more than that many numbers. [B] uint8 -> [...] int8 or uint8

    Raises:
        ValueError: they are not as many.
    """
    size = check_levels(shape)
    if packed.dtype != torch.uint8 or packed.ndim != 1:
        raise ValueError(f"packed levels are {list(packed.shape)} {packed.dtype}, expected bytes")
    try:
        content = zlib.decompressobj().decompress(packed.numpy().tobytes(), size + 1)
    except zlib.error as error:
        raise ValueError(f"levels are no zlib stream ({error})") from None
    if len(content) != size:
        raise ValueError(f"{len(content)} packed levels, expected {list(shape)}")
    return torch.from_numpy(np.frombuffer(content, np.int8).copy()).view(dtype).view(*shape)


def open_npy(path: str | os.PathLike[str], what: str = "numbers") -> NDArray[Any]:
    """The array of a .npy file, of whole numbers, fractions or bools; its bytes are read when they are used.

    Args:
        path: the file
        what: its numbers are, for the message

    Raises:
        ProgdfError: no such file, or none that `numpy.save` wrote of numbers.
    """
    check_regular(path)
    try:
        array: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    except OSError as error:
        raise open_error(path, error) from None
    except Exception:  # numpy reads the header as a Python literal, and raises whatever that raises
        raise ProgdfError(
            f"{path} is not a readable .npy file of {what}; save them with numpy.save"
        ) from None
    if array.dtype.kind not in "fiub":
        raise ProgdfError(f"{path} holds {array.dtype.name}, not {what}; save them with numpy.save")
    return array


def save_npy(path: str | os.PathLike[str], array: NDArray[Any]) -> None:
    """Write an array, whole or not at all.

    Raises:
        ProgdfError: see `atomic_write`.
    """
    stored = io.BytesIO()
    np.save(stored, array)
    with atomic_write(path) as temporary_file:
        temporary_file.write_bytes(stored.getvalue())
