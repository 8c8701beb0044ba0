"""Real diffusers pipelines with tiny random networks and a generated tokenizer, saved like real ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
from PIL import ImageStat

from tests.helpers.tiny_clip import CLIP_VOCABULARY, clip_tokenizer, write_vocabulary

_VISION = [f"<|{name}|>" for name in ("vision_start", "vision_end", "image_pad")]
_QWEN = [f"<|{name}|>" for name in ("endoftext", "im_start", "im_end")]
_VAE: dict[str, Any] = {
    "block_out_channels": (8, 8, 8, 8),
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "latent_channels": 4,
    "norm_num_groups": 4,
}
_UNET: dict[str, Any] = {
    "block_out_channels": (8, 16),
    "layers_per_block": 1,
    "sample_size": 16,
    "in_channels": 8,  # noise and picture
    "out_channels": 4,
    "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
    "up_block_types": ("CrossAttnUpBlock2D", "UpBlock2D"),
    "cross_attention_dim": 16,
    "attention_head_dim": 4,
    "norm_num_groups": 4,
}
_FLUX: dict[str, Any] = {
    "patch_size": 1,
    "in_channels": 16,
    "num_layers": 1,
    "num_single_layers": 1,
    "attention_head_dim": 16,
    "num_attention_heads": 2,
}


def pix2pix_pipeline(folder: Path) -> Any:
    """Return a StableDiffusionInstructPix2PixPipeline of about 100 000 parameters.

    Its vocabulary is written into `folder`.
    """
    from diffusers import (
        AutoencoderKL,
        EulerAncestralDiscreteScheduler,
        StableDiffusionInstructPix2PixPipeline,
        UNet2DConditionModel,
    )

    torch.manual_seed(0)
    unet = UNet2DConditionModel(**_UNET)
    vae = AutoencoderKL(**_VAE)
    return StableDiffusionInstructPix2PixPipeline(
        vae=vae.eval(),
        text_encoder=_clip(16),
        tokenizer=clip_tokenizer(folder / "words"),
        unet=unet.eval(),
        scheduler=EulerAncestralDiscreteScheduler(),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )


def pix2pix_xl_pipeline(folder: Path) -> Any:
    """Return a StableDiffusionXLInstructPix2PixPipeline of about 100 000 parameters."""
    from diffusers import (
        AutoencoderKL,
        EulerDiscreteScheduler,
        StableDiffusionXLInstructPix2PixPipeline,
        UNet2DConditionModel,
    )

    torch.manual_seed(0)
    unet = UNet2DConditionModel(
        **{**_UNET, "cross_attention_dim": 32},
        addition_embed_type="text_time",
        addition_time_embed_dim=8,
        projection_class_embeddings_input_dim=16 + 6 * 8,
    )
    return StableDiffusionXLInstructPix2PixPipeline(
        vae=AutoencoderKL(**_VAE).eval(),
        text_encoder=_clip(16),
        text_encoder_2=_clip(16, projects=True),
        tokenizer=clip_tokenizer(folder / "words"),
        tokenizer_2=clip_tokenizer(folder / "words"),
        unet=unet.eval(),
        scheduler=EulerDiscreteScheduler(),
        add_watermarker=False,
    )


def kontext_pipeline(folder: Path) -> Any:
    """Return a FluxKontextPipeline of about 100 000 parameters."""
    from diffusers import FlowMatchEulerDiscreteScheduler, FluxKontextPipeline, FluxTransformer2DModel
    from transformers import T5Config, T5EncoderModel

    torch.manual_seed(0)
    transformer = FluxTransformer2DModel(
        **_FLUX,
        joint_attention_dim=32,
        pooled_projection_dim=16,
        axes_dims_rope=(4, 4, 8),
        guidance_embeds=True,
    )
    vae = _flux_vae()
    t5 = T5EncoderModel(
        T5Config(vocab_size=64, d_model=32, d_kv=8, d_ff=16, num_layers=1, num_heads=2)
    ).eval()
    return FluxKontextPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(),
        vae=vae,
        text_encoder=_clip(16),
        tokenizer=clip_tokenizer(folder / "words"),
        text_encoder_2=t5,
        tokenizer_2=_t5_tokenizer(),
        transformer=transformer.eval(),
    )


def klein_pipeline(folder: Path, kind: str = "Flux2KleinPipeline", is_distilled: bool = True) -> Any:
    """Return a Flux2KleinPipeline, Flux2KleinKVPipeline or Flux2Pipeline of about 100 000 parameters."""
    import diffusers
    from transformers import Qwen3Config, Qwen3ForCausalLM

    torch.manual_seed(0)
    is_dev = kind == "Flux2Pipeline"  # it uses hidden states 10, 20 and 30, the others 9, 18 and 27
    text = Qwen3ForCausalLM(
        Qwen3Config(
            vocab_size=160,
            hidden_size=16,
            intermediate_size=16,
            num_hidden_layers=31 if is_dev else 28,
            num_attention_heads=2,
            num_key_value_heads=2,
            head_dim=8,
        )
    ).eval()
    transformer = diffusers.Flux2Transformer2DModel(
        **_FLUX,
        joint_attention_dim=48,
        timestep_guidance_channels=16,
        axes_dims_rope=(4, 4, 4, 4),
        guidance_embeds=is_dev,
    )
    vae = diffusers.AutoencoderKLFlux2(**_VAE, layers_per_block=1, sample_size=32)
    words = _qwen_tokenizer(folder / "words")
    parts = {
        "scheduler": diffusers.FlowMatchEulerDiscreteScheduler(),
        "vae": vae.eval(),
        "text_encoder": text,
        "tokenizer": _Conversation(words) if is_dev else words,
        "transformer": transformer.eval(),
    }
    if kind == "Flux2KleinPipeline":
        parts["is_distilled"] = is_distilled
    return getattr(diffusers, kind)(**parts)


def qwen_pipeline(folder: Path, kind: str = "QwenImageEditPlusPipeline") -> Any:
    """Return a QwenImageEditPlusPipeline or QwenImageEditPipeline with a simulated image reader."""
    import diffusers

    torch.manual_seed(0)
    transformer = diffusers.QwenImageTransformer2DModel(
        patch_size=2,
        in_channels=16,
        out_channels=4,
        num_layers=1,
        attention_head_dim=16,
        num_attention_heads=2,
        joint_attention_dim=16,
        axes_dims_rope=(4, 4, 8),
    )
    vae = diffusers.AutoencoderKLQwenImage(
        base_dim=8,
        z_dim=4,
        dim_mult=[1, 1, 1, 1],
        num_res_blocks=1,
        temperal_downsample=[False, True, True],
        latents_mean=[0.0] * 4,
        latents_std=[1.0] * 4,
    )
    return getattr(diffusers, kind)(
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(),
        vae=vae.eval(),
        text_encoder=_Reader(),
        tokenizer=_qwen_tokenizer(folder / "words"),
        processor=_ReaderInput(),
        transformer=transformer.eval(),
    )


def longcat_pipeline(folder: Path) -> Any:
    """Return a LongCatImageEditPipeline with a simulated image reader."""
    import diffusers

    torch.manual_seed(0)
    transformer = diffusers.LongCatImageTransformer2DModel(
        patch_size=1,
        in_channels=64,  # its pipeline assumes 16 channels of latents
        num_layers=1,
        num_single_layers=1,
        attention_head_dim=16,
        num_attention_heads=2,
        joint_attention_dim=16,
        pooled_projection_dim=16,
        axes_dims_rope=(4, 4, 8),
    )
    words = _qwen_tokenizer(folder / "words")
    words.add_tokens(_VISION, special_tokens=True)
    return diffusers.LongCatImageEditPipeline(
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(),
        vae=_flux_vae(latent_channels=16),
        text_encoder=_Reader(),
        tokenizer=words,
        text_processor=_ReaderInput(),
        transformer=transformer.eval(),
    )


PIPELINES: dict[str, Callable[[Path], Any]] = {
    "StableDiffusionInstructPix2PixPipeline": pix2pix_pipeline,
    "StableDiffusionXLInstructPix2PixPipeline": pix2pix_xl_pipeline,
    "FluxKontextPipeline": kontext_pipeline,
    **{
        kind: partial(klein_pipeline, kind=kind)
        for kind in ("Flux2KleinPipeline", "Flux2KleinKVPipeline", "Flux2Pipeline")
    },
    **{
        kind: partial(qwen_pipeline, kind=kind)
        for kind in ("QwenImageEditPipeline", "QwenImageEditPlusPipeline")
    },
    "LongCatImageEditPipeline": longcat_pipeline,
}
"""Class in diffusers -> builder of a tiny one in memory."""


def tiny_instruct_pix2pix(folder: Path) -> Path:
    """Save a StableDiffusionInstructPix2PixPipeline. Return its path."""
    return _saved(pix2pix_pipeline(folder), folder)


def tiny_flux_kontext(folder: Path) -> Path:
    """Save a FluxKontextPipeline. Return its path."""
    return _saved(kontext_pipeline(folder), folder)


def tiny_flux2_klein(folder: Path) -> Path:
    """Save a Flux2KleinPipeline. Return its path."""
    return _saved(klein_pipeline(folder), folder)


class _Conversation:
    """Source of FLUX.2 dev's tokens."""

    def __init__(self, words: Any) -> None:
        self._words = words

    def apply_chat_template(self, conversations: Any, **_: Any) -> Any:
        texts = [
            turn["content"][0]["text"] for talk in conversations for turn in talk if turn["role"] == "user"
        ]
        return self._words(texts, padding="max_length", truncation=True, max_length=77, return_tensors="pt")


class _ReaderInput:
    """Input of `_Reader`: characters as words, and the mean color of a picture."""

    merge_size = 1

    def __call__(self, text: Any = None, images: Any = None, **_: Any) -> Any:
        from transformers import BatchFeature

        pictures = images if isinstance(images, list) else [images]
        means = torch.stack([torch.tensor(ImageStat.Stat(p.convert("RGB")).mean) / 255 for p in pictures])
        found = {"pixel_values": means, "image_grid_thw": torch.tensor([[1, 1, 1]])}
        if text is not None:
            tokens = torch.tensor([[ord(c) % 128 for c in (text[0][:30] + text[0][-90:]).ljust(120)]])
            found |= {"input_ids": tokens, "attention_mask": torch.ones_like(tokens)}
        return BatchFeature(found)

    @property
    def image_processor(self) -> _ReaderInput:
        return self


class _Reader(torch.nn.Module):
    """Text encoder that also receives the picture."""

    def __init__(self) -> None:
        super().__init__()
        self.words, self.colors = torch.nn.Embedding(256, 16), torch.nn.Linear(3, 16)

    @property
    def dtype(self) -> torch.dtype:
        return self.colors.weight.dtype

    @property
    def device(self) -> torch.device:
        return self.colors.weight.device

    def forward(self, input_ids: Any, pixel_values: Any = None, **_: Any) -> Any:
        read = self.words(input_ids) + self.colors(pixel_values.to(self.dtype)).mean(dim=0)
        return SimpleNamespace(hidden_states=[read])


def _flux_vae(**more: Any) -> Any:
    from diffusers import AutoencoderKL

    settings = {**_VAE, **more}
    return AutoencoderKL(
        **settings, use_quant_conv=False, use_post_quant_conv=False, shift_factor=0.1, scaling_factor=0.4
    ).eval()


def _saved(pipeline: Any, folder: Path) -> Path:
    pipeline.save_pretrained(folder / "pipeline")
    return folder / "pipeline"


def _clip(width: int, projects: bool = False) -> Any:
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection

    return (CLIPTextModelWithProjection if projects else CLIPTextModel)(
        CLIPTextConfig(
            vocab_size=CLIP_VOCABULARY,
            hidden_size=width,
            intermediate_size=width,
            num_attention_heads=2,
            num_hidden_layers=1,
            max_position_embeddings=77,
            projection_dim=width,
            bos_token_id=0,
            eos_token_id=1,
        )
    ).eval()


def _t5_tokenizer() -> Any:
    from transformers import T5Tokenizer

    pieces = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), ("▁", -2.0)]
    pieces += [(chr(c), -3.0) for c in range(ord("a"), ord("z") + 1)]
    return T5Tokenizer(vocab=pieces, extra_ids=0, model_max_length=77)


def _qwen_tokenizer(folder: Path) -> Any:
    from transformers import Qwen2Tokenizer

    write_vocabulary(folder, [*(chr(c) for c in range(33, 127)), "Ġ", "Ċ", *_QWEN])
    tokenizer = Qwen2Tokenizer.from_pretrained(folder, model_max_length=77)
    tokenizer.chat_template = "{% for m in messages %}<|im_start|>{{ m['content'] }}<|im_end|>{% endfor %}"
    return tokenizer


@contextmanager
def small_megapixels(side: int) -> Iterator[None]:
    """Replace the megapixel to which some pipelines scale every picture by a square of this side."""
    from diffusers.pipelines.longcat_image import pipeline_longcat_image_edit as longcat
    from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit as qwen
    from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit_plus as plus

    area = side * side
    with ExitStack() as changes:
        for name in ("VAE_IMAGE_SIZE", "CONDITION_IMAGE_SIZE"):
            changes.enter_context(patch.object(plus, name, area))
        for module in (longcat, qwen):
            inner = module.calculate_dimensions
            changes.enter_context(
                patch.object(module, "calculate_dimensions", lambda _, ratio, inner=inner: inner(area, ratio))
            )
        yield
