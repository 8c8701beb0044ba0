"""Safetensors files whose bytes depend on what is in them and on nothing else.

The safetensors library writes the metadata in an order that differs from run to run, so the same training
would give a file with another hash each time. Reading is left to the library, which knows nothing of damaged
numbers: a checksum of everything may be in the metadata.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

_CHECKSUM = "crc32"
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


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str], checksum: bool = False
) -> None:
    """Write a safetensors file: header size (8 bytes, little endian), JSON header, the tensors' bytes.

    Args:
        path: where to; see `files.atomic_write` for a file that is whole or absent
        tensors: by name, of the types in the table above; on the CPU
        metadata: texts by name
        checksum: add one of everything, which `read_tensors` compares

    Raises:
        KeyError: a tensor of another type.
        OSError: the place cannot be written.
    """
    # the widest types first, so that everything is aligned
    ordered = sorted(tensors.items(), key=lambda item: (-item[1].element_size(), item[0]))
    if checksum:
        metadata = {**metadata, _CHECKSUM: _checksum(metadata, tensors)}
    header: dict[str, object] = {"__metadata__": dict(sorted(metadata.items()))}
    end = 0
    for name, tensor in ordered:
        start, end = end, end + tensor.numel() * tensor.element_size()
        shape = list(tensor.shape)
        header[name] = {"dtype": _TYPES[tensor.dtype], "shape": shape, "data_offsets": [start, end]}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for _, tensor in ordered:
            file.write(_bytes(tensor))


def read_tensors(path: Path, names: Collection[str] = ()) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a file, all of them where none are named, and its metadata.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no safetensors file, lacks a tensor, or was damaged. Some are not checked.
    """
    try:
        with safe_open(path, framework="pt") as opened:
            metadata = dict(opened.metadata() or {})
            tensors = {name: opened.get_tensor(name) for name in names or opened.keys()}
    except OSError:
        raise
    except Exception as error:  # the library's own, and torch's where a shape overflows
        raise ValueError(" ".join(str(error).split())) from None
    sum_ = metadata.pop(_CHECKSUM, None)
    if not names and sum_ is not None and sum_ != _checksum(metadata, tensors):
        raise ValueError("checksum mismatch")
    return tensors, metadata


def _checksum(metadata: Mapping[str, str], tensors: Mapping[str, Tensor]) -> str:
    sum_ = zlib.crc32(repr((sorted(metadata.items()), sorted(table_of(tensors).items()))).encode())
    for name in sorted(tensors):
        sum_ = zlib.crc32(_bytes(tensors[name]), sum_)
    return f"{sum_:08x}"


def _bytes(tensor: Tensor) -> memoryview:
    content: memoryview = tensor.detach().contiguous().reshape(-1).view(torch.uint8).numpy().data
    return content
