"""A .npy file of numbers: written whole; read mapped, so that a header that lies allocates nothing."""

from __future__ import annotations

import io
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.errors import ProgdfError

from .atomic import atomic_write, check_regular, open_error


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
