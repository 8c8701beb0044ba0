"""Simulated GPU: tensors with their values on the CPU that report another device.

Operations that would fail on a GPU fail here: an operation between a tensor on the GPU and a CPU tensor that
is not a single number, and a numpy array of a tensor on the GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

CARD = torch.device("meta")
"""Device of the simulated tensors; torch knows it, and no other tensor here uses it."""

_MOVES = ("aten::_to_copy", "aten::copy_")


class OnCard(Tensor):
    """A tensor on the simulated GPU. `values` holds its numbers on the CPU."""

    values: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, values: Tensor) -> OnCard:
        tensor = torch.Tensor._make_wrapper_subclass(
            cls,
            values.shape,
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device=CARD,
        )
        tensor.values = values
        return tensor

    def tolist(self) -> Any:
        """Return the values as any tensor does."""
        return self.values.tolist()

    def new_tensor(self, *args: Any, **kwargs: Any) -> Tensor:
        """Return a new tensor on the same device, which torch makes without dispatch."""
        return OnCard(self.values.new_tensor(*args, **kwargs))

    def __getitem__(self, index: Any) -> Tensor:
        """Return the indexed part. Torch makes index tensors of lists without dispatch."""
        parts = index if isinstance(index, tuple) else (index,)
        parts = tuple(
            OnCard(torch.tensor(some)) if isinstance(some, list | tuple) else some for some in parts
        )
        return super().__getitem__(parts)

    @classmethod
    def __torch_dispatch__(
        cls, function: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        return _run(function, args, kwargs or {})


class Card(TorchDispatchMode):
    """Mode in which tensors can be made on CARD.

    `moved` counts the numbers moved to it and from it, `read` the single numbers that the program waits for.
    """

    moved = 0
    read = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        if function.name().split(".")[0] in _MOVES:
            result = _run(function, args, kwargs or {})
            sides = {isinstance(some, OnCard) for some in (*args[:2], result) if isinstance(some, Tensor)}
            self.moved += result.numel() if len(sides) == 2 and result.ndim else 0
            return result
        if function.name().startswith("aten::_local_scalar_dense"):
            self.read += isinstance(args[0], OnCard)
        return _run(function, args, kwargs or {})


def _run(function: Callable[..., Any], args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    name = function.name().split(".")[0]  # type: ignore[attr-defined]
    tensors = [some for some in tree_flatten((args, kwargs))[0] if isinstance(some, Tensor)]
    is_there = any(isinstance(some, OnCard) for some in tensors)
    elsewhere = [some for some in tensors if not isinstance(some, OnCard) and some.ndim]
    if any(some.device == CARD for some in elsewhere):
        raise RuntimeError(f"{name}: a tensor on the card that was made where nobody looked")
    if is_there and elsewhere and name not in _MOVES:
        raise RuntimeError(
            f"{name}: tensors on the card and elsewhere, {[tuple(s.shape) for s in elsewhere]}"
        )
    device = kwargs.get("device")
    goes_there = is_there if device is None else torch.device(device) == CARD
    plain = dict(kwargs) | ({"device": torch.device("cpu")} if device is not None else {})
    values = function(*tree_map(_values, args), **tree_map(_values, plain))
    if name.endswith("_") and not name.endswith("__"):
        return args[0]
    return tree_map(_place, values) if goes_there else values


def _values(some: Any) -> Any:
    return some.values if isinstance(some, OnCard) else some


def _place(some: Any) -> Any:
    return OnCard(some) if isinstance(some, Tensor) else some
