"""A real CLIP with tiny random networks and a tokenizer made here, saved as real ones are."""

from __future__ import annotations

import json
from pathlib import Path

import torch

_WORDS = ["<|startoftext|>", "<|endoftext|>", *(chr(c) for c in range(33, 127))]


def tiny_clip(folder: Path, seed: int = 0) -> Path:
    """A CLIPModel of about 30 000 parameters that takes pictures of 32 pixels, in `folder`."""
    from transformers import CLIPConfig, CLIPModel, CLIPTokenizer

    torch.manual_seed(seed)
    small = {"hidden_size": 16, "intermediate_size": 32, "num_attention_heads": 2, "num_hidden_layers": 2}
    config = CLIPConfig(
        text_config={
            **small,
            "vocab_size": 2 * len(_WORDS),
            "max_position_embeddings": 77,
            "bos_token_id": 0,
            "eos_token_id": 1,
        },
        vision_config={**small, "image_size": 32, "patch_size": 8},
        projection_dim=12,
    )
    CLIPModel(config).save_pretrained(folder)
    letters = _WORDS + [f"{letter}</w>" for letter in _WORDS[2:]]
    (folder / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(letters)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    CLIPTokenizer.from_pretrained(folder, model_max_length=77).save_pretrained(folder)
    return folder
