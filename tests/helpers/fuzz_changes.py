"""Changes that `tests.helpers.fuzz` makes to valid files: bytes, values of JSON and tensors."""

from __future__ import annotations

import copy
import json
import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import safetensors.torch
import torch

from progdf.gdf.header import checksum
from progdf.io.tensors import write_tensors
from tests.helpers.hostile import JSON_TEXTS

VALUES: list[Any] = [
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        7,
        2**31,
        2**63,
        -(2**70),
        1e-300,
        1e300,
        0.5,
        "",
        "a",
        "means",
        "\0",
        "/",
    ),
    *("\x1b[2J\n", "ä" * 300, "9" * 5000, [], {}, [[]], [0] * 5000, {"a": {"b": []}}, "../../../etc/passwd"),
    *(
        "../victim.region.npy",
        "../../victim.region.npy",
        "/tmp/../victim.region.npy",
        "n" * 300 + ".region.npy",
    ),
]
"""Replacements for values of a file."""

Change = Callable[[random.Random, Path], None]
"""Function that writes another input to a path."""


def changed_bytes(content: bytes) -> Change:
    """Return a change of bytes, as by damaged disks and downloads."""

    def change(rng: random.Random, path: Path) -> None:
        data = bytearray(content)
        for _ in range(rng.choice([1, 1, 1, 2, 6])):
            at = (
                rng.randrange(len(data) + 1) if rng.random() < 0.5 else rng.randrange(min(len(data), 400) + 1)
            )
            length = rng.choice([1, 1, 2, 4, 8, 100])
            kind = rng.randrange(6)
            if kind == 0:
                data[at : at + 1] = bytes([rng.randrange(256)])
            elif kind == 1:
                data[at : at + length] = rng.choice([b"\xff", b"\0", b"9", b"["]) * length
            elif kind == 2:
                data[at:at] = rng.randbytes(length)
            elif kind == 3:
                data[at:at] = data[at : at + 50 * length]
            elif kind == 4:
                del data[at : at + length]
            else:
                del data[at:]
        path.write_bytes(bytes(data))

    return change


def changed_value(rng: random.Random, value: Any) -> Any:
    """Return a JSON value with one to three of its parts replaced, removed or doubled."""
    value = json.loads(json.dumps(value))
    for _ in range(rng.choice([1, 1, 2, 3])):
        inner = None
        place = None
        found = value
        while isinstance(found, dict | list) and found and rng.random() < 0.8:
            inner = found
            place = rng.choice(list(found) if isinstance(found, dict) else range(len(found)))
            found = inner[place]
        other = copy.deepcopy(rng.choice(VALUES))  # a copy, as it may be inserted into itself
        if inner is None or place is None:
            value = other if rng.random() < 0.2 else value
        elif (kind := rng.randrange(6)) == 0:
            del inner[place]
        elif kind == 1 and isinstance(inner, dict):
            inner[rng.choice(["extra", "", "a" * 5000, "\x1b"])] = other
        elif kind == 2 and isinstance(inner, list):
            inner.append(inner[place])
        elif kind == 3 and isinstance(found, int | float):
            inner[place] = rng.choice([-found, found * 1e30, found + 1, str(found), [found]])
        else:
            inner[place] = other
    return value


def changed_json(content: bytes) -> Change:
    """Return a change of JSON values, and sometimes of the syntax."""

    def change(rng: random.Random, path: Path) -> None:
        text = json.dumps(changed_value(rng, json.loads(content)))
        if rng.random() < 0.1:
            at = rng.randrange(len(text))
            text = text[:at] + rng.choice(list(JSON_TEXTS.values())) + text[at + 1 :]
        path.write_text(text)

    return change


def changed_glb(content: bytes) -> Change:
    """Return a change of values in the JSON of a .glb, whose lengths fit afterwards."""
    size = int.from_bytes(content[12:16], "little")
    change_json = changed_json(content[20 : 20 + size])

    def change(rng: random.Random, path: Path) -> None:
        change_json(rng, path)
        text = path.read_bytes()
        text += b" " * (-len(text) % 4)
        length = 20 + len(text) + len(content) - 20 - size
        head = b"glTF" + struct.pack("<IIII", 2, length, len(text), 0x4E4F534A)
        path.write_bytes(head + text + content[20 + size :])

    return change


def changed_tensors(rng: random.Random, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return tensors of which one has other values, another type, shape or name, or is missing."""
    tensors = dict(tensors)
    name = rng.choice(sorted(tensors))
    tensor = tensors.pop(name)
    kind = rng.randrange(7)
    if kind == 0:
        tensors[name] = tensor[: len(tensor) // 2] if tensor.ndim else tensor
    elif kind == 1:
        tensors[name] = tensor.to(
            rng.choice([torch.float64, torch.int8, torch.uint8, torch.int64, torch.float16])
        )
    elif kind == 2:
        tensors[name] = tensor.reshape(
            rng.choice([(-1,), (1, -1), (-1, 1)]) if tensor.numel() else tensor.shape
        )
    elif kind == 3:
        tensors[name] = tensor.clone()
        tensors[name].reshape(-1)[: rng.choice([1, 5, 10**6])] = rng.choice([0, -1, 1, 100])
    elif kind == 4 and tensor.is_floating_point():
        filled = tensor.clone().reshape(-1)
        filled[: rng.choice([1, 10**6])] = rng.choice([3e38, -3e38, float("nan"), float("inf"), 1e-40])
        tensors[name] = filled.reshape(tensor.shape)
    elif kind == 5:
        tensors["extra"] = tensor
    return tensors


def header_of(content: bytes) -> Any:
    """Return the JSON header of a .gdf file with an empty checksum."""
    size = int.from_bytes(content[:8], "little")
    return json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["progdf"]) | {"sha256": ""}


def signed_gdf(header: Any, tensors: dict[str, torch.Tensor]) -> bytes:
    """Return a .gdf file of these parts with a matching checksum, as a wrong writer would make it."""
    if isinstance(header, dict):
        header = {**header, "sha256": checksum(json.dumps({**header, "sha256": ""}), tensors)}
    return safetensors.torch.save(tensors, {"progdf": json.dumps(header)})


def changed_gdf(content: bytes) -> Change:
    """Return a change of an edit's header or tensors, with a matching checksum."""
    header = header_of(content)
    tensors = safetensors.torch.load(content)

    def change(rng: random.Random, path: Path) -> None:
        value = changed_value(rng, header) if rng.random() < 0.7 else header
        found = changed_tensors(rng, tensors) if rng.random() < 0.5 else tensors
        found = {name: tensor.contiguous() for name, tensor in found.items()}
        path.write_bytes(signed_gdf(value, found))

    return change


def changed_parts(content: bytes, key: str) -> Change:
    """Return a change of a tensor file's JSON metadata or tensors, with a matching checksum."""
    size = int.from_bytes(content[:8], "little")
    metadata = json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["progdf"])
    metadata.pop("crc32", None)
    tensors = safetensors.torch.load(content)

    def change(rng: random.Random, path: Path) -> None:
        changed = metadata
        if rng.random() < 0.6:
            changed = {**metadata, key: json.dumps(changed_value(rng, json.loads(metadata[key])))}
        found = changed_tensors(rng, tensors) if rng.random() < 0.6 else tensors
        write_tensors(path, found, changed)

    return change
