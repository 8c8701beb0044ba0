"""Pretrained networks on this machine: their folders, checks for complete weights, and error messages."""

from __future__ import annotations

import gc
import json
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open

from progdf.errors import ProgdfError

BROKEN = (OSError, ValueError, RuntimeError, KeyError, TypeError, SafetensorError)
"""Exceptions of transformers and diffusers for a model that is missing, incomplete or of the wrong type."""

_T = TypeVar("_T")


class LastValueCache:
    """Cache of the last object of each kind in this process."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[object, Any]] = {}

    def get(self, what: str, key: object, make: Callable[[], _T]) -> _T:
        """Return the cached object of kind `what` if its key is equal, else make and cache a new one."""
        if what not in self._last or self._last[what][0] != key:
            self._last.pop(what, None)  # before `make`, so that two objects are never in memory
            self._last[what] = key, make()
        value: _T = self._last[what][1]
        return value


_models: LastValueCache | None = None


def keep_models() -> None:
    """Keep the last model of each kind in memory from now on, for a process that trains many edits."""
    global _models
    _models = _models or LastValueCache()


def last_model(kind: str, key: object, load: Callable[[], _T]) -> _T:
    """Return the result of `load`, or after `keep_models` the last one of this kind if its key is equal."""
    return load() if _models is None else _models.get(kind, key, load)


def folder_of_model(model: str, file: str) -> Path:
    """Return the local folder of a model that contains this file.

    Args:
        model: a folder, or an id on the Hugging Face hub
        file: relative to the model

    Raises:
        one of `BROKEN`: the model is not on this machine.
    """
    if Path(model).is_dir():
        return Path(model)
    from huggingface_hub import try_to_load_from_cache

    cached = try_to_load_from_cache(model, file)
    if not isinstance(cached, str):
        raise OSError(f"{model} is not on this machine")
    return Path(cached).parent


def missing_weights(model: str, kind: str, of_folder: str, download: str) -> ProgdfError:
    """Return the error for a missing or incomplete model, with the remedy.

    Args:
        model: a folder, or an id on the Hugging Face hub
        kind: type of the model, in words
        of_folder: end of the message for a folder
        download: end of the message for an id, after `hf download ID`
    """
    if Path(model).is_dir() or model.startswith((".", "/", "~")):
        return ProgdfError(f"{model} does not hold a complete {kind} with safetensors weights{of_folder}")
    return ProgdfError(
        f"the weights of {model} are not on this machine or are incomplete; download them with "
        f"'hf download {model}{download}"
    )


def keep_quiet(*speaks: Any) -> None:
    """Limit these logging modules to errors: the libraries warn about every missing optional package."""
    for module in speaks:
        module.set_verbosity(logging.ERROR)
        module.disable_progress_bar()


def weights_here(folder: Path) -> int:
    """Return the number of weights of a network, from the headers of its files.

    Raises:
        one of `BROKEN`: the folder holds no weights, a file is missing, or a file is truncated.
    """
    files = set(folder.glob("*.safetensors"))
    for index in folder.glob("*.safetensors.index.json"):
        files |= {folder / name for name in json.loads(index.read_bytes())["weight_map"].values()}
    if not files:
        raise OSError(f"{folder} holds no weights")
    count = 0
    for file in files:
        with safe_open(file, framework="pt") as weights:
            count += sum(math.prod(weights.get_slice(name).get_shape()) for name in weights.keys())  # noqa: SIM118
    return count


def gpu_memory() -> tuple[int, int] | None:
    """Return the free and total bytes of the GPU that torch uses; None without a GPU."""
    if not torch.cuda.is_available():
        return None
    gc.collect()  # memory of a previous network counts as free
    torch.cuda.empty_cache()
    return torch.cuda.mem_get_info()


def model_device(choice: str = "auto") -> str:
    """Return the device for pretrained networks: "cuda" if `choice` is "auto" and torch finds a GPU."""
    return "cuda" if choice == "auto" and torch.cuda.is_available() else "cpu"
