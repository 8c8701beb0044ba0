"""Tests of .npy and safetensors files: values load as saved, other content is one line without allocation."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor

from progdf.io.tensors import open_npy, read_tensors, write_tensors
from tests.helpers.hostile import NPY_HEADERS, npy
from tests.helpers.refused import refusal

TYPES = (
    *(torch.float64, torch.float32, torch.float16),
    *(torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8, torch.bool),
)


def some(dtype: torch.dtype) -> dict[str, Tensor]:
    """Return tensors of a type in every relevant shape: empty, one value, not contiguous."""
    full = torch.arange(24).reshape(2, 3, 4).to(dtype)
    return {"b": full, "none": full[:0], "a": full[1, 2, 3], "turned": full.permute(2, 0, 1)}


@pytest.mark.parametrize("dtype", TYPES, ids=str)
def test_safetensors_reads_every_type_and_shape(tmp_path: Path, dtype: torch.dtype) -> None:
    tensors = {**some(dtype), "wide": torch.tensor([0.1], dtype=torch.float64)}
    write_tensors(tmp_path / "x", tensors, {"z": "ä", "a": '"{}"'})
    found = load_file(tmp_path / "x")
    assert found.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor)
    with safe_open(tmp_path / "x", framework="pt") as opened:
        metadata = opened.metadata()
    texts = json.loads(metadata.pop("progdf"))
    assert len(texts.pop("crc32")) == 8
    assert texts == {"z": "ä", "a": '"{}"'}
    assert not metadata


def test_input_order_changes_no_byte(tmp_path: Path) -> None:
    tensors = some(torch.float32)
    metadata = {"format": "1", "about": "2", "sha": "3"}
    write_tensors(tmp_path / "x", tensors, metadata)
    write_tensors(tmp_path / "y", dict(reversed(tensors.items())), dict(reversed(metadata.items())))
    assert (tmp_path / "x").read_bytes() == (tmp_path / "y").read_bytes()


def test_every_tensor_is_aligned_to_its_type(tmp_path: Path) -> None:
    tensors = {"a": torch.zeros(3, dtype=torch.int8), "b": torch.zeros(5, dtype=torch.float16)}
    write_tensors(tmp_path / "x", {**tensors, "c": torch.ones(1, dtype=torch.float64)}, {})
    content = (tmp_path / "x").read_bytes()
    size = int.from_bytes(content[:8], "little")
    assert size % 8 == 0
    assert content[8 + size : 16 + size] == b"\0\0\0\0\0\0\xf0\x3f"  # 1.0 is first


def test_every_flipped_bit_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "x"
    write_tensors(path, {"a": torch.arange(4.0), "b": torch.arange(3)}, {"about": "it"})
    tensors, metadata = read_tensors(path)
    assert torch.equal(tensors["a"], torch.arange(4.0))
    assert metadata == {"about": "it"}
    content = path.read_bytes()
    for place in range(len(content)):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        with pytest.raises(ValueError):  # noqa: PT011  the library's words
            read_tensors(path)
    for length in range(len(content)):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError):  # noqa: PT011  the library's words
            read_tensors(path)


@pytest.mark.parametrize("header", NPY_HEADERS.values(), ids=NPY_HEADERS.keys())
def test_hostile_header_is_refused_without_allocation(header: bytes, tmp_path: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refusal(open_npy, npy(tmp_path / "a.npy", header))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_other_content_is_no_npy(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    for content in (b"", b"\x93NUMPY", b"PK\x03\x04", b"\x93NUMPY\x07\x00" + b"\0" * 90):
        path.write_bytes(content)
        refusal(open_npy, path)
    assert "does not exist" in refusal(open_npy, tmp_path / "none.npy")


@pytest.mark.parametrize("dtype", ["<f4", ">i2", "u1", "?"])
def test_arrays_of_any_type_are_read(dtype: str, tmp_path: Path) -> None:
    numbers = np.array([[0, 1], [1, 0]]).astype(dtype)
    np.save(tmp_path / "a.npy", numbers)
    assert np.array_equal(open_npy(tmp_path / "a.npy"), numbers)
