"""Pretrained networks on this machine: where they lie, whether they are whole, what goes wrong with them."""

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
"""What transformers and diffusers raise for a model that is not there, not whole, or another's."""

_T = TypeVar("_T")


class Shared:
    """What was made last in this process, one of each kind, for who asks for the same next."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[object, Any]] = {}

    def get(self, what: str, key: object, make: Callable[[], _T]) -> _T:
        """What `make` gives, or gave when it was last asked for `what` with an equal key."""
        if what not in self._last or self._last[what][0] != key:
            self._last.pop(what, None)  # first, so that two are never in memory
            self._last[what] = key, make()
        value: _T = self._last[what][1]
        return value


_models: Shared | None = None


def keep_models() -> None:
    """From now on the last model of each kind stays in memory, for a process that trains many edits."""
    global _models
    _models = _models or Shared()


def last_model(kind: str, key: object, load: Callable[[], _T]) -> _T:
    """What `load` gives; after `keep_models`, what it gave last for this kind if the key is the same."""
    return load() if _models is None else _models.get(kind, key, load)


def folder_of_model(model: str, file: str) -> Path:
    """Where a model lies that has this file.

    Args:
        model: a folder, or an id on the Hugging Face hub
        file: relative to the model

    Raises:
        one of `BROKEN`: it is not on this machine.
    """
    if Path(model).is_dir():
        return Path(model)
    from huggingface_hub import try_to_load_from_cache

    cached = try_to_load_from_cache(model, file)
    if not isinstance(cached, str):
        raise OSError(f"{model} is not on this machine")
    return Path(cached).parent


def missing_weights(model: str, kind: str, of_folder: str, download: str) -> ProgdfError:
    """What to do where a model is not here, or not whole.

    Args:
        model: a folder, or an id on the Hugging Face hub
        kind: of model
        of_folder, download: how the line ends for a folder; and for an id, after hf download ID
    """
    if Path(model).is_dir() or model.startswith((".", "/", "~")):
        return ProgdfError(f"{model} does not hold a complete {kind} with safetensors weights{of_folder}")
    return ProgdfError(
        f"the weights of {model} are not on this machine or are incomplete; download them with "
        f"'hf download {model}{download}"
    )


def keep_quiet(*speaks: Any) -> None:
    """Errors alone from libraries, by their logging modules: they warn of every package that is optional."""
    for module in speaks:
        module.set_verbosity(logging.ERROR)
        module.disable_progress_bar()


def weights_here(folder: Path) -> int:
    """How many numbers a network's weights hold, by the heads of its files.

    Raises:
        one of `BROKEN`: there are none, one of several files is missing, or one is truncated.
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
    """Free and total bytes of the graphics card that torch uses; None where there is none."""
    if not torch.cuda.is_available():
        return None
    gc.collect()  # what a network before left is free too
    torch.cuda.empty_cache()
    return torch.cuda.mem_get_info()


def model_device(choice: str = "auto") -> str:
    """Where pretrained networks run: "cuda" where torch has a graphics card, unless "cpu" is asked for."""
    return "cuda" if choice == "auto" and torch.cuda.is_available() else "cpu"
