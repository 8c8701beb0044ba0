"""Scene files in formats other than .ply, written by gaussforge if it is correct, else by hand."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.formats.ply import save_ply
from progdf.formats.scene_file import rotate_about_x
from progdf.gaussians import Gaussians
from progdf.sh import C0


def write_scene(path: Path, scene: Gaussians, spz_version: int = 4) -> Path:
    """Write the scene in the format of the path's ending (.spz, .splat, .sog), or skip without gaussforge."""
    gaussforge = pytest.importorskip("gaussforge")
    kind = path.suffix.lstrip(".")
    plain = path.with_suffix(".plain.ply")
    save_ply(plain, rotate_about_x(scene) if kind == "spz" else scene)  # gaussforge keeps the axes
    found = gaussforge.GaussForge().convert(plain.read_bytes(), "ply", kind, spz_version=spz_version)
    plain.unlink()
    path.write_bytes(found["data"])
    return path


def write_compressed_ply(path: Path, scene: Gaussians, comment: str = "", colors: bool = True) -> Path:
    """Write as SuperSplat does; without `colors` as it did before chunks had a color range."""
    n = len(scene)
    places = scene.means.numpy()
    scales = scene.log_scales.numpy()
    rgb = (scene.sh0 * C0 + 0.5).numpy()
    edges = [range(i, min(i + 256, n)) for i in range(0, n, 256)]
    kinds = [places, scales, rgb] if colors else [places, scales]
    chunks = [np.concatenate([f(v[e], axis=0) for v in kinds for f in (np.min, np.max)]) for e in edges]
    of = np.arange(n) // 256
    table = np.stack(chunks)[of].reshape(n, len(kinds), 2, 3)
    shares = [
        (v - table[:, k, 0]) / np.maximum(table[:, k, 1] - table[:, k, 0], 1e-12) for k, v in enumerate(kinds)
    ]
    if not colors:
        shares.append(rgb.clip(0, 1))
    quats = scene.unit_quats.numpy()
    which = np.abs(quats).argmax(axis=1)
    quats = quats * np.sign(np.take_along_axis(quats, which[:, None], 1))
    others = np.stack([np.delete(q, w) for q, w in zip(quats, which, strict=True)]) / np.sqrt(2) + 0.5
    alpha = scene.opacities.numpy()[:, None]
    words = [
        _packed(shares[0], (11, 10, 11)),
        (which.astype(np.uint32) << 30) | _packed(others, (10, 10, 10)),
        _packed(shares[1], (11, 10, 11)),
        _packed(np.concatenate([shares[2], alpha], axis=1), (8, 8, 8, 8)),
    ]
    names = [
        f"{e}_{p}{x}"
        for p, xs in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
        for e in ("min", "max")
        for x in xs
    ]
    rest = scene.shN.transpose(1, 2).flatten(1).numpy()
    head = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    head += [f"element chunk {len(edges)}", *(f"property float {name}" for name in names[: 6 * len(kinds)])]
    head += [f"element vertex {n}"]
    head += [f"property uint packed_{what}" for what in ("position", "rotation", "scale", "color")]
    if rest.shape[1]:
        head += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    content = ("\n".join([*head, "end_header"]) + "\n").encode()
    content += np.stack(chunks).astype("<f4").tobytes() + np.stack(words, axis=1).astype("<u4").tobytes()
    path.write_bytes(content + np.clip((rest / 8 + 0.5) * 256, 0, 255).astype(np.uint8).tobytes())
    return path


def write_sog1(path: Path, scene: Gaussians) -> Path:
    """Write SOG version 1, a zip archive or, without an ending, a folder; each SH row is a palette row.

    The scene has at most 256 Gaussians.
    """
    count = len(scene)
    side = -(-count // 16)
    tables = {
        "means": scene.means.sign() * scene.means.abs().log1p(),
        "scales": scene.log_scales,
        "sh0": torch.cat([scene.sh0, scene.logit_opacities[:, None]], dim=1),
    }
    meta: dict[str, dict[str, object]] = {}
    images: dict[str, np.ndarray] = {}
    for name, values in tables.items():
        table = values.double().numpy()
        low = table.min(axis=0)
        high = table.max(axis=0)
        max_level = 65535 if name == "means" else 255
        levels = np.round((table - low) / np.maximum(high - low, 1e-9) * max_level).astype(np.int64)
        parts = {"means_l": levels & 255, "means_u": levels >> 8} if name == "means" else {name: levels}
        images |= parts
        files = [f"{part}.webp" for part in parts]
        meta[name] = {"shape": [*table.shape], "mins": low.tolist(), "maxs": high.tolist(), "files": files}
    quats = scene.unit_quats.numpy()
    largest = np.abs(quats).argmax(axis=1)
    quats = quats * np.sign(np.take_along_axis(quats, largest[:, None], 1))
    others = np.stack([np.delete(q, index) for q, index in zip(quats, largest, strict=True)])
    levels = np.round((others / np.sqrt(2) + 0.5) * 255).astype(np.int64)
    images["quats"] = np.concatenate([levels, 252 + largest[:, None]], axis=1)
    meta["quats"] = {"shape": [count, 4], "encoding": "quaternion_packed", "files": ["quats.webp"]}
    pixels = {name: _grid(values, (side, 16)) for name, values in images.items()}
    if functions := scene.shN.shape[1]:
        low = float(scene.shN.min())
        high = float(scene.shN.max())
        levels = np.round((scene.shN.numpy() - low) / (high - low) * 255).astype(np.int64)
        labels = np.stack([np.arange(count) & 255, np.arange(count) >> 8, np.zeros(count, np.int64)], axis=1)
        rows = -(-count // 64)
        pixels["shN_centroids"] = _grid(levels.reshape(-1, 3), (rows, 64 * functions))
        pixels["shN_labels"] = _grid(labels, (side, 16))
        files = ["shN_centroids.webp", "shN_labels.webp"]
        shape = [count, 3 * functions]
        meta["shN"] = {"shape": shape, "mins": low, "maxs": high, "quantization": 8, "files": files}
    contents = {"meta.json": json.dumps(meta).encode()}
    for name, image in pixels.items():
        stream = io.BytesIO()
        Image.fromarray(image).save(stream, "WEBP", lossless=True, exact=True)
        contents[f"{name}.webp"] = stream.getvalue()
    if path.suffix:
        return write_zip(path, contents)
    path.mkdir()
    for name, content in contents.items():
        (path / name).write_bytes(content)
    return path


def write_zip(path: Path, contents: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> Path:
    """Write a zip archive of files by their names."""
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return path


def _grid(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return rows of channels as an image, padded with zeros. [N,C] -> [H,W,C] uint8"""
    image = np.zeros((shape[0] * shape[1], values.shape[1]), np.uint8)
    image[: len(values)] = values
    return image.reshape(*shape, -1)


def write_ksplat(path: Path, scene: Gaussians, level: int, per_bucket: int = 32, block: float = 20.0) -> Path:
    """Write as GaussianSplats3D does: one section, whose last two buckets are partial."""
    n = len(scene)
    degree = scene.sh_degree
    sizes = [per_bucket, n % per_bucket]
    full = n // per_bucket - 1
    buckets = n // per_bucket + 1
    of = np.arange(n) // per_bucket
    places = scene.means.numpy()
    centers = np.stack([places[of == b].mean(0) for b in range(buckets)]).astype("<f4")
    bands = [
        scene.shN[:, l * l - 1 : (l + 1) ** 2 - 1].transpose(1, 2).flatten(1) for l in range(1, degree + 1)
    ]
    sh = torch.cat([torch.zeros(n, 0), *bands], dim=1).numpy()
    rgba = np.concatenate([(scene.sh0 * C0 + 0.5).numpy(), scene.opacities.numpy()[:, None]], axis=1)
    colors = np.round(rgba.clip(0, 1) * 255).astype(np.uint8)
    kind = "<f2" if level else "<f4"
    shares = np.round((places - centers[of]) * (32767 / (block / 2))) + 32767
    columns = [shares.astype("<u2") if level else places.astype("<f4")]
    columns += [scene.scales.numpy().astype(kind), scene.unit_quats.numpy().astype(kind), colors]
    columns.append(
        np.round((sh + 1.5) / 3 * 255).clip(0, 255).astype(np.uint8) if level == 2 else sh.astype(kind)
    )
    rows = np.concatenate([np.ascontiguousarray(c).view(np.uint8).reshape(n, -1) for c in columns], axis=1)
    header = bytearray(4096)
    section = bytearray(1024)
    struct.pack_into("<BB", header, 0, 0, 1)
    struct.pack_into("<II", header, 4, 1, 1)
    struct.pack_into("<IIH", header, 12, n, n, level)
    struct.pack_into("<ff", header, 36, -1.5, 1.5)
    struct.pack_into("<IIIIfHxxI", section, 0, n, n, per_bucket, buckets, block, 12, 32767)
    struct.pack_into("<IIH", section, 32, full, len(sizes), degree)
    path.write_bytes(
        bytes(header) + bytes(section) + struct.pack("<II", *sizes) + centers.tobytes() + rows.tobytes()
    )
    return path


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    word = np.zeros(len(shares), np.uint32)
    for share, width in zip(shares.T, bits, strict=True):
        level = np.round(share.clip(0, 1) * (2**width - 1)).astype(np.uint32)
        word = (word << np.uint32(width)) | level
    return word
