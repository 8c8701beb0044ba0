"""Files made to do harm or damaged by a disk."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path


def npy(path: Path, header: bytes, magic: bytes = b"\x93NUMPY\x01\x00") -> Path:
    """Write a .npy file with this header and 64 bytes of numbers."""
    path.write_bytes(magic + len(header).to_bytes(2, "little") + header + b"\0" * 64)
    return path


def chunk(kind: bytes, content: bytes) -> bytes:
    """Return a chunk of a .png."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def bomb(path: Path, width: int, height: int) -> Path:
    """Write a PNG of a few kilobytes that claims many pixels."""
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    rows = chunk(b"IDAT", zlib.compress(b"\0" * 2_000_000, 9))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + rows + chunk(b"IEND", b""))
    return path


NPY_HEADERS = {
    "pickled objects": b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n",
    "more than the file has": b"{'descr': '<f8', 'fortran_order': False, 'shape': (9000000000,), }\n",
    "more than memory has": b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }\n" % 10**30,
    "a negative side": b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }\n",
    "an unfinished literal": b"{'descr': '<f8', 'fortran_order': (\n",
    "no literal": b"\xff\xfe = 3 ?\n",
    "a deep literal": b"(" * 9000 + b"\n",
    "deep signs": b"-" * 9000 + b"1\n",
    "another type": b"{'descr': {}, 'fortran_order': False, 'shape': (1,), }\n",
    "text": b"{'descr': '<U4', 'fortran_order': False, 'shape': (1,), }\n",
    "a shape of text": b"{'descr': '<f8', 'fortran_order': False, 'shape': ('a',), }\n",
}

JSON_TEXTS = {
    "a number of 400 digits": "9" * 400,
    "a negative one": "-" + "9" * 400,
    "a number beyond all": "1e999",
    "no number": "NaN",
    "infinity": "-Infinity",
    "deep lists": "[" * 100_000 + "]" * 100_000,
    "lists too deep to walk through": "[" * 500 + "]" * 500,
    "deep tables": '{"a":' * 500 + "1" + "}" * 500,
    "half a character": '"\\ud800"',
    "half a character as a key": '{"\\udfff": 1}',
    "a key twice": '{"a": 1, "a": 2}',
}
