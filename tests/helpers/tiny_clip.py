"""A real CLIP with tiny random networks and a generated tokenizer, saved like real ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

_LETTERS = [chr(c) for c in range(33, 127)]
_WORDS = ["<|startoftext|>", "<|endoftext|>", *_LETTERS, *(f"{letter}</w>" for letter in _LETTERS)]
CLIP_VOCABULARY = len(_WORDS) + 2
"""Two rows more than there are words, as real models have spare ones."""


def tiny_clip(folder: Path, seed: int = 0) -> Path:
    """Save a CLIPModel of about 30 000 parameters for pictures of 32 pixels in `folder`. Return its path."""
    from transformers import CLIPConfig, CLIPModel

    torch.manual_seed(seed)
    small = {"hidden_size": 16, "intermediate_size": 32, "num_attention_heads": 2, "num_hidden_layers": 2}
    config = CLIPConfig(
        text_config={
            **small,
            "vocab_size": CLIP_VOCABULARY,
            "max_position_embeddings": 77,
            "bos_token_id": 0,
            "eos_token_id": 1,
        },
        vision_config={**small, "image_size": 32, "patch_size": 8},
        projection_dim=12,
    )
    CLIPModel(config).save_pretrained(folder)
    clip_tokenizer(folder).save_pretrained(folder)
    return folder


def clip_tokenizer(folder: Path) -> Any:
    """Return a CLIPTokenizer that knows single letters, and write its files into `folder`."""
    from transformers import CLIPTokenizer

    write_vocabulary(folder, _WORDS)
    return CLIPTokenizer.from_pretrained(folder, model_max_length=77)


def write_vocabulary(folder: Path, words: Sequence[str]) -> None:
    """Write the two files of a byte-pair tokenizer that never merges."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(words)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
