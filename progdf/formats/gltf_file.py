"""Container of glTF 2.0 files (.glb, .gltf): the JSON, its buffers and its accessors.

Buffers are in the .glb, beside the file, or in data: URIs. All sizes are checked against the size of the file
before memory is allocated. https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import base64
import binascii
import os
import re
import struct
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, TypeVar
from urllib.parse import unquote_to_bytes

import msgspec
import numpy as np
from numpy.typing import NDArray

from progdf.errors import ProgdfError
from progdf.io.atomic import read_file
from progdf.io.file_rules import damage_error, unsupported_error
from progdf.io.json_values import convert_json, decode_json
from progdf.terminal import escape_text, group_digits

MAGIC = b"glTF"
JSON_CHUNK = 0x4E4F534A
BINARY_CHUNK = 0x004E4942

FLOAT = 5126
BYTE = 5121
_SHORT_INDEX = 5123
_INT_INDEX = 5125
_NUMBER_TYPES = {5120: "i1", BYTE: "u1", 5122: "<i2", _SHORT_INDEX: "<u2", _INT_INDEX: "<u4", FLOAT: "<f4"}
_INDEX_TYPES = (BYTE, _SHORT_INDEX, _INT_INDEX)
SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

MAX_JSON_VALUES = 2_000_000
"""Largest number of values in the JSON. A parsed value takes up to 100 bytes of memory."""

MAX_EXPANSION = 16
"""Largest ratio of decoded bytes to file size. Repeated meshes and byte-to-float decoding raise it."""

MIN_DECODED_BYTES = 64 << 20
"""Decoded bytes that are always allowed, however small the file is."""

BYTES_PER_DRAW = 16 << 10
"""Decoded bytes that each additional part adds beside its rows, to bound the time for many tiny parts."""

_MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
DECOMPRESS = "decompress it with `gltf-transform copy in.glb out.glb`"

T = TypeVar("T")
REFUSED_EXTENSIONS = {
    "EXT_meshopt_compression": DECOMPRESS,
    "KHR_meshopt_compression": DECOMPRESS,
    "KHR_draco_mesh_compression": DECOMPRESS,
    "EXT_mesh_gpu_instancing": "export it with a node for each instance",
}
"""Unsupported extensions that change Gaussians → the remedy."""

Count = Annotated[int, msgspec.Meta(ge=0)]
Vector = tuple[float, float, float]


class Buffer(msgspec.Struct, frozen=True):
    """Block of bytes inside or outside the file."""

    byteLength: Count
    uri: str | None = None


class BufferView(msgspec.Struct, frozen=True):
    """Part of a buffer (`bufferView` in glTF)."""

    buffer: Count
    byteLength: Count
    byteOffset: Count = 0
    byteStride: Count = 0
    extensions: dict[str, Any] = {}


class SparseIndices(msgspec.Struct, frozen=True):
    """Indices of the rows that a sparse accessor replaces."""

    bufferView: Count
    componentType: int
    byteOffset: Count = 0


class SparseValues(msgspec.Struct, frozen=True):
    """Values of the replaced rows."""

    bufferView: Count
    byteOffset: Count = 0


class Sparse(msgspec.Struct, frozen=True):
    """Rows of an accessor that replace those of its buffer view."""

    count: Count
    indices: SparseIndices
    values: SparseValues


class Accessor(msgspec.Struct, frozen=True):
    """Typed rows of a buffer view; zeros if there is no view."""

    componentType: int
    count: Count
    type: str
    bufferView: Count | None = None
    byteOffset: Count = 0
    normalized: bool = False
    sparse: Sparse | None = None


class Primitive(msgspec.Struct, frozen=True):
    """Part of a mesh, here a set of points."""

    attributes: dict[str, Count] = {}
    indices: Count | None = None
    targets: list[Any] = []
    extensions: dict[str, Any] = {}


class Mesh(msgspec.Struct, frozen=True):
    """Primitives that are drawn together."""

    primitives: list[Primitive]


class Node(msgspec.Struct, frozen=True):
    """Transform with children and an optional mesh."""

    name: str = ""
    mesh: Count | None = None
    skin: Count | None = None
    matrix: Annotated[list[float], msgspec.Meta(min_length=16, max_length=16)] | None = None
    translation: Vector | None = None
    rotation: tuple[float, float, float, float] | None = None
    scale: Vector | None = None
    children: list[Count] = []
    extensions: dict[str, Any] = {}


class SceneEntry(msgspec.Struct, frozen=True):
    """Root nodes that are drawn together."""

    nodes: list[Count] = []


class Asset(msgspec.Struct, frozen=True):
    """Version and origin of a file."""

    version: str
    minVersion: str = "2.0"
    generator: str = ""
    extras: Any = None


class Tables(msgspec.Struct, frozen=True):
    """Parts of the glTF JSON that are needed to read Gaussians."""

    asset: Asset
    buffers: list[Buffer] = []
    bufferViews: list[BufferView] = []
    accessors: list[Accessor] = []
    meshes: list[Mesh] = []
    nodes: list[Node] = []
    scenes: list[SceneEntry] = []
    scene: Count | None = None
    animations: list[Any] = []
    extensionsUsed: list[str] = []
    extensionsRequired: list[str] = []


class GltfFile:
    """Opened glTF file. External buffers are read on first use."""

    path: Path
    tables: Tables
    stored_bytes: int  # size of the file and of the external buffers read so far

    def __init__(self, path: Path) -> None:
        """Read the JSON.

        Raises:
            ProgdfError: the file is missing, damaged, or not glTF 2.
        """
        self.path = path
        content = read_file(path)
        self.stored_bytes = len(content)
        self._decoded_bytes = 0
        self._files: dict[Path, memoryview] = {}
        self._buffers: dict[int, memoryview] = {}
        text = content
        self._binary = None
        if content[:4] == MAGIC:
            text, self._binary = _split_chunks(path, content)
        elif path.suffix.lower() == ".glb":
            raise damage_error(path, "it does not begin with glTF")
        self.tables = _read_tables(path, text)

    def view_bytes(self, index: int) -> memoryview:
        """Return the bytes of a buffer view.

        Raises:
            ProgdfError: the view is compressed, or its buffer is missing or too short.
        """
        view = entry(self, self.tables.bufferViews, index, "bufferViews")
        if view.buffer not in self._buffers:
            compression = next((name for name in _MESHOPT if name in view.extensions), None)
            if compression is not None and not self._has_data(view.buffer):
                raise unsupported_error(self.path, f"compression ({compression})", DECOMPRESS)
            self._buffers[view.buffer] = self._read_buffer(view.buffer)
        data = self._buffers[view.buffer]
        end = view.byteOffset + view.byteLength
        if end > len(data):
            limit = f"byte {end} of buffers[{view.buffer}], which has {len(data)}"
            raise damage_error(self.path, f"bufferViews[{index}] ends at {limit}")
        return data[view.byteOffset : end]

    def read_accessor(self, index: int, kind: str) -> NDArray[np.float32]:
        """Return the rows of an accessor; normalized integers become −1 to 1 or 0 to 1. [count,size]

        Args:
            index: position in the list of accessors
            kind: the expected type, one of `SIZES`

        Raises:
            ProgdfError: the type differs, or rows lie outside the file.
        """
        accessor = self.accessor(index, kind)
        values = self._rows(accessor, f"accessors[{index}]").astype(np.float32)
        is_normalized = accessor.normalized and accessor.componentType != FLOAT
        if is_normalized:
            largest = np.iinfo(_NUMBER_TYPES[accessor.componentType]).max
            values = np.maximum(values / np.float32(largest), np.float32(-1.0))
        return values

    def read_indices(self, index: int, rows: int) -> NDArray[np.int64]:
        """Return the row indices that an accessor lists, each checked to be below `rows`. [count]"""
        accessor = self.accessor(index, "SCALAR")
        name = f"accessors[{index}]"
        if accessor.componentType not in _INDEX_TYPES:
            raise damage_error(self.path, f"{name} holds row numbers of type {accessor.componentType}")
        indices = self._rows(accessor, name)[:, 0].astype(np.int64)
        self._check_below(indices, rows, name)
        return indices

    def accessor(self, index: int, kind: str) -> Accessor:
        """Return an accessor of the given type.

        Raises:
            ProgdfError: the accessor does not exist, has the wrong type or has no rows.
        """
        accessor = entry(self, self.tables.accessors, index, "accessors")
        if accessor.type != kind or accessor.componentType not in _NUMBER_TYPES:
            found = f"{escape_text(accessor.type)[:20]} of {accessor.componentType}"
            raise damage_error(self.path, f"accessors[{index}] is {found}, not {kind}")
        if not accessor.count:
            raise damage_error(self.path, f"accessors[{index}] has no rows")
        return accessor

    def take(self, rows: int, width: int) -> None:
        """Add rows that are about to be allocated to the total of decoded bytes.

        Args:
            rows: number of further rows
            width: numbers per row

        Raises:
            ProgdfError: the total exceeds `MAX_EXPANSION` times the size of the file.
        """
        self._decoded_bytes += BYTES_PER_DRAW + 4 * rows * width
        limit = max(MIN_DECODED_BYTES, MAX_EXPANSION * self.stored_bytes)
        if self._decoded_bytes > limit:
            raise ProgdfError(
                f"{self.path} repeats its rows beyond {MAX_EXPANSION} times its size: over "
                f"{group_digits(limit >> 20)} MB of Gaussians in {group_digits(self.stored_bytes)} bytes; "
                "export it with each Gaussian stored once"
            )

    def _rows(self, accessor: Accessor, name: str) -> NDArray[Any]:
        """Return the stored numbers of an accessor, with sparse rows applied. [count,size]"""
        dtype = np.dtype(_NUMBER_TYPES[accessor.componentType])
        size = SIZES[accessor.type]
        if accessor.bufferView is None:
            self.take(accessor.count, size)
            values = np.zeros((accessor.count, size), dtype)
        else:
            view = entry(self, self.tables.bufferViews, accessor.bufferView, "bufferViews")
            data = self.view_bytes(accessor.bufferView)
            values = self._table(
                data, accessor.byteOffset, accessor.count, size, dtype, view.byteStride, name
            )
        sparse = accessor.sparse
        if sparse is None or not sparse.count:
            return values
        if sparse.count > accessor.count:
            raise damage_error(
                self.path, f"{name} replaces {sparse.count} rows, more than its {accessor.count}"
            )
        indices = sparse.indices
        replaced = sparse.values
        if indices.componentType not in _INDEX_TYPES:
            raise damage_error(self.path, f"{name} holds row numbers of type {indices.componentType}")
        index_type = np.dtype(_NUMBER_TYPES[indices.componentType])
        index_data = self.view_bytes(indices.bufferView)
        rows = self._table(index_data, indices.byteOffset, sparse.count, 1, index_type, 0, name)[:, 0]
        self._check_below(rows, accessor.count, name)
        value_data = self.view_bytes(replaced.bufferView)
        values = values.copy()
        values[rows] = self._table(value_data, replaced.byteOffset, sparse.count, size, dtype, 0, name)
        return values

    def _table(
        self,
        data: memoryview,
        start: int,
        count: int,
        size: int,
        dtype: np.dtype[Any],
        stride: int,
        name: str,
    ) -> NDArray[Any]:
        """Return a view of rows of numbers inside `data`. [count,size]"""
        width = size * dtype.itemsize
        stride = stride or width
        end = start + (count - 1) * stride + width
        if stride < width:
            raise damage_error(self.path, f"{name} has rows of {width} bytes every {stride} bytes")
        if end > len(data):
            raise damage_error(self.path, f"{name} ends at byte {end} of its data, which has {len(data)}")
        return np.ndarray((count, size), dtype, data, start, (stride, dtype.itemsize))

    def _check_below(self, indices: NDArray[Any], rows: int, name: str) -> None:
        if len(indices) and int(indices.max()) >= rows:
            raise damage_error(self.path, f"{name} names row {int(indices.max())} of {rows}")

    def _has_data(self, index: int) -> bool:
        buffer = entry(self, self.tables.buffers, index, "buffers")
        return buffer.uri is not None or (index == 0 and self._binary is not None)

    def _read_buffer(self, index: int) -> memoryview:
        """Return the bytes of a buffer, exactly as many as it declares.

        Raises:
            ProgdfError: the buffer is missing or too short.
        """
        buffer = entry(self, self.tables.buffers, index, "buffers")
        if buffer.uri is None:
            if index or self._binary is None:
                raise damage_error(self.path, f"buffers[{index}] has neither bytes nor the name of a file")
            source = self.path
            data = self._binary
        elif buffer.uri[:5].lower() == "data:":
            source = self.path
            data = self._read_data_uri(buffer.uri, index)
        else:
            source = self._resolve(buffer.uri, index)
            if source not in self._files:
                if not os.path.exists(source):
                    raise ProgdfError(
                        f"{source} does not exist, but {self.path} needs it; put both in one folder"
                    )
                needed_bytes = max(
                    other.byteLength for other in self.tables.buffers if other.uri == buffer.uri
                )
                size = os.path.getsize(source)  # `read_file` allocates as many bytes as requested
                self._files[source] = memoryview(read_file(source, min(needed_bytes, size)))
                self.stored_bytes += len(self._files[source])
            data = self._files[source]
        if len(data) < buffer.byteLength:
            raise damage_error(source, f"it has {len(data)} of {buffer.byteLength} bytes of buffers[{index}]")
        return data[: buffer.byteLength]

    def _read_data_uri(self, uri: str, index: int) -> memoryview:
        head, comma, body = uri.partition(",")
        try:
            if not comma:
                raise ValueError
            if head.lower().endswith(";base64"):
                return memoryview(base64.b64decode(unquote_to_bytes(body), validate=True))
            return memoryview(unquote_to_bytes(body))
        except (ValueError, binascii.Error):
            raise damage_error(self.path, f"the data: URI of buffers[{index}] is not base64") from None

    def _resolve(self, uri: str, index: int) -> Path:
        """Return the file that a buffer refers to, inside the folder of the .gltf."""
        label = escape_text(uri)[:80]
        scheme = re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", uri)
        if scheme is not None:
            remedy = "put the file into the folder of the scene and name it there"
            raise unsupported_error(self.path, f"the address {label} for buffers[{index}]", remedy)
        try:
            name = unquote_to_bytes(uri).decode()
        except UnicodeDecodeError:
            name = ""
        posix = PurePosixPath(name)
        windows = PureWindowsPath(name)
        outside = posix.is_absolute() or bool(windows.anchor) or ".." in (*posix.parts, *windows.parts)
        if outside or not posix.parts or "\0" in name:
            raise ProgdfError(
                f"{self.path} keeps buffers[{index}] outside its folder ({label}); move that file into the "
                "folder and name it there"
            )
        return self.path.parent / posix


def entry(file: GltfFile, entries: list[T], index: int, name: str) -> T:
    """Return an entry of one of the file's lists; raise ProgdfError if the list is too short."""
    if index >= len(entries):
        raise damage_error(file.path, f"it refers to {name}[{index}], of {len(entries)}")
    return entries[index]


def _split_chunks(path: Path, content: bytes) -> tuple[bytes, memoryview | None]:
    """Return the JSON and the binary chunk of a .glb."""
    if len(content) < 20:
        raise damage_error(path, f"it has {len(content)} bytes, fewer than a header")
    version, length, text_size, kind = struct.unpack_from("<IIII", content, 4)
    if version != 2:
        raise unsupported_error(path, f"version {version} of .glb", "export it as glTF 2.0")
    if length > len(content):
        raise damage_error(path, f"it has {len(content)} of {length} bytes")
    text_end = 20 + text_size
    if kind != JSON_CHUNK or text_end > len(content):
        raise damage_error(path, "its first part is not the whole JSON")
    binary = None
    if text_end + 8 <= len(content):
        size, kind = struct.unpack_from("<II", content, text_end)
        start = text_end + 8
        if kind == BINARY_CHUNK:
            binary = memoryview(content)[start : start + size]
    return content[20:text_end], binary


def _read_tables(path: Path, text: bytes) -> Tables:
    """Parse and check the tables of the JSON."""
    values = text.count(b",") + text.count(b"{") + text.count(b"[")
    if values > MAX_JSON_VALUES:
        raise ProgdfError(
            f"{path} lists {group_digits(values)} values in its JSON, more than "
            f"{group_digits(MAX_JSON_VALUES)}; export it with its numbers in a buffer"
        )
    try:
        table = decode_json(text)
    except ValueError as error:
        raise damage_error(path, f"its JSON cannot be read: {error}") from None
    asset = table.get("asset") if isinstance(table, dict) else None
    if not isinstance(asset, dict) or "version" not in asset:
        raise damage_error(path, "its JSON names no version of glTF")
    for name, known in (("version", r"2\.\d+"), ("minVersion", r"2\.0")):
        version = asset.get(name, "2.0")
        if isinstance(version, str) and re.fullmatch(known, version) is None:
            feature = f"glTF {escape_text(version)[:20]} (asset.{name})"
            raise unsupported_error(path, feature, "export it as glTF 2.0")
    try:
        return convert_json(table, Tables)
    except ValueError as error:
        raise damage_error(path, _explain(str(error))) from None


def _explain(text: str) -> str:
    """Return an error of `convert_json` in terms of glTF, without those of Python or JSON schemas."""
    if text.endswith(" is missing"):
        return text
    return re.sub(r", expected .*|: [^:]*$", ", which glTF does not allow", escape_text(text), count=1)
