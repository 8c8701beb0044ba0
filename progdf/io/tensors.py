"""Tensor files: reproducible safetensors files with a checksum, and .npy files.

The safetensors library writes several metadata keys in an order that differs from run to run. All metadata is
therefore one JSON text under one key, so that equal contents give equal bytes. safetensors does not detect
damaged numbers, so the metadata includes a checksum.
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
"""Only key of a file's metadata."""

_CHECKSUM = "crc32"
_MAX_LEVELS = 1 << 30  # limit of unpacked levels: a file of 1 MB could request that many
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


def tensor_specs(tensors: Mapping[str, Tensor]) -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shape and the safetensors type name of each tensor.

    Raises:
        KeyError: the type of a tensor is not supported.
    """
    return {name: (tuple(tensor.shape), _TYPES[tensor.dtype]) for name, tensor in tensors.items()}


def check_tensor(name: str, tensor: Tensor, shape: Sequence[int | None], *types: torch.dtype) -> None:
    """Raise ValueError if a tensor has the wrong shape or type.

    Args:
        name: name of the tensor for the error
        tensor: the tensor
        shape: expected shape; None stands for any size
        types: allowed types
    """
    fits = len(shape) == tensor.ndim and all(
        n in (None, side) for n, side in zip(shape, tensor.shape, strict=True)
    )
    if not fits or tensor.dtype not in types:
        expected_sides = ", ".join("any" if side is None else str(side) for side in shape)
        kinds = " or ".join(str(kind).removeprefix("torch.") for kind in types)
        kind = str(tensor.dtype).removeprefix("torch.")
        raise ValueError(f"{name} is {list(tensor.shape)} {kind}, expected [{expected_sides}] {kinds}")


def check_ascent(name: str, numbers: Tensor) -> None:
    """Raise ValueError if numbers do not strictly ascend from 0 to 1. [n]"""
    limits = numbers[[0, -1]].tolist() if numbers.ndim == 1 and len(numbers) > 1 else []
    if limits != [0.0, 1.0] or not bool((numbers.diff() > 0).all()):
        raise ValueError(f"{name} must ascend from 0 to 1")


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a safetensors file.

    Args:
        path: the file; the write is not atomic, see `atomic.atomic_write`
        tensors: CPU tensors by name, of the types that `tensor_specs` supports
        metadata: texts by name; a checksum of the contents is added, which `read_tensors` verifies

    Raises:
        KeyError: the type of a tensor is not supported.
        OSError: the file cannot be written.
    """
    metadata = {**metadata, _CHECKSUM: _checksum(metadata, tensors)}
    text = msgspec.json.encode(dict(sorted(metadata.items()))).decode()
    arrays = {name: tensor.detach().contiguous().numpy() for name, tensor in tensors.items()}
    path.write_bytes(save(arrays, {METADATA: text}))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors and the metadata of a file, and verify its checksum.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not a safetensors file of this program, or is damaged.
    """
    try:
        with safe_open(path, framework="pt") as opened:
            metadata = msgspec.json.decode((opened.metadata() or {})[METADATA], type=dict[str, str])
            tensors = {name: opened.get_tensor(name) for name in sorted(opened.keys())}
    except OSError:
        raise
    except KeyError:
        raise ValueError("it was not written by progdf") from None
    except Exception as error:  # safetensors' own errors, and torch's if a shape overflows
        raise ValueError(" ".join(str(error).split())) from None
    if metadata.pop(_CHECKSUM, None) != _checksum(metadata, tensors):
        raise ValueError("checksum mismatch")
    return tensors, metadata


def _checksum(metadata: Mapping[str, object], tensors: Mapping[str, Tensor]) -> str:
    sum_ = zlib.crc32(repr((sorted(metadata.items()), sorted(tensor_specs(tensors).items()))).encode())
    for name in sorted(tensors):
        sum_ = zlib.crc32(
            tensors[name].detach().contiguous().reshape(-1).view(torch.uint8).numpy().data, sum_
        )
    return f"{sum_:08x}"


def deflate(levels: Tensor) -> Tensor:
    """Compress 8-bit integers with zlib, by the shorter of two strategies. Returns [B] uint8.

    Noise-like levels compress best with Huffman codes alone, or with run lengths. Both give shorter results
    than zlib's search for repetitions, and are ten times as fast (docs/lab/experiments.md, Levels of a
    residual).
    """
    content = levels.contiguous().numpy().tobytes()

    def pack(strategy: int) -> bytes:
        packing = zlib.compressobj(strategy=strategy)
        return packing.compress(content) + packing.flush()

    packed = min(map(pack, (zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE)), key=len)
    return torch.from_numpy(np.frombuffer(packed, np.uint8).copy())


def check_levels(shape: Sequence[int]) -> int:
    """Return the number of levels in a shape; raise ValueError if it exceeds `_MAX_LEVELS`.

    The limit stops a small damaged file from requesting unbounded memory.
    """
    size = math.prod(shape)
    if size > _MAX_LEVELS:
        raise ValueError(f"{list(shape)} packed levels, more than {_MAX_LEVELS}")
    return size


def inflate(packed: Tensor, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Decompress the output of `deflate` to a given shape. [B] uint8 -> [...] int8 or uint8

    Raises:
        ValueError: the bytes are not a zlib stream, or do not hold exactly as many numbers.
    """
    size = check_levels(shape)
    if packed.dtype != torch.uint8 or packed.ndim != 1:
        raise ValueError(f"packed levels are {list(packed.shape)} {packed.dtype}, expected bytes")
    try:
        content = zlib.decompressobj().decompress(packed.numpy().tobytes(), size + 1)
    except zlib.error as error:
        raise ValueError(f"levels are not a zlib stream ({error})") from None
    if len(content) != size:
        raise ValueError(f"{len(content)} packed levels, expected {list(shape)}")
    return torch.from_numpy(np.frombuffer(content, np.int8).copy()).view(dtype).view(*shape)


def open_npy(path: str | os.PathLike[str], what: str = "numbers") -> NDArray[Any]:
    """Open a .npy file of integers, floats or bools as a memory map.

    Args:
        path: the file
        what: meaning of the numbers, for errors

    Raises:
        ProgdfError: the file does not exist, or is not a numeric .npy file.
    """
    check_regular(path)
    try:
        array: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    except OSError as error:
        raise open_error(path, error) from None
    except Exception:  # numpy parses the header as a Python literal, which can raise many types
        raise ProgdfError(
            f"{path} is not a readable .npy file of {what}; save them with numpy.save"
        ) from None
    if array.dtype.kind not in "fiub":
        raise ProgdfError(f"{path} holds {array.dtype.name}, not {what}; save them with numpy.save")
    return array


def save_npy(path: str | os.PathLike[str], array: NDArray[Any]) -> None:
    """Write an array to a .npy file, complete or not at all.

    Raises:
        ProgdfError: see `atomic_write`.
    """
    stored = io.BytesIO()
    np.save(stored, array)
    with atomic_write(path) as temporary_file:
        temporary_file.write_bytes(stored.getvalue())
