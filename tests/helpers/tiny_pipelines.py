"""Real pipelines of diffusers with tiny random networks and a tokenizer made here, saved as real ones are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from tests.helpers.tiny_clip import CLIP_VOCABULARY, clip_tokenizer, write_vocabulary

_QWEN = [f"<|{name}|>" for name in ("endoftext", "im_start", "im_end")]
_VAE: dict[str, Any] = {
    "block_out_channels": (8, 8, 8, 8),
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "latent_channels": 4,
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


def tiny_instruct_pix2pix(folder: Path) -> Path:
    """A StableDiffusionInstructPix2PixPipeline of about 100 000 parameters in `folder`."""
    from diffusers import (
        AutoencoderKL,
        EulerAncestralDiscreteScheduler,
        StableDiffusionInstructPix2PixPipeline,
        UNet2DConditionModel,
    )

    torch.manual_seed(0)
    unet = UNet2DConditionModel(
        block_out_channels=(8, 16),
        layers_per_block=1,
        sample_size=16,
        in_channels=8,  # the noise and the picture
        out_channels=4,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=16,
        attention_head_dim=4,
        norm_num_groups=4,
    )
    vae = AutoencoderKL(**_VAE)
    pipeline = StableDiffusionInstructPix2PixPipeline(
        vae=vae.eval(),
        text_encoder=_clip(16),
        tokenizer=clip_tokenizer(folder / "words"),
        unet=unet.eval(),
        scheduler=EulerAncestralDiscreteScheduler(),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    return _saved(pipeline, folder)


def tiny_flux_kontext(folder: Path) -> Path:
    """A FluxKontextPipeline of about 100 000 parameters in `folder`."""
    from diffusers import (
        AutoencoderKL,
        FlowMatchEulerDiscreteScheduler,
        FluxKontextPipeline,
        FluxTransformer2DModel,
    )
    from transformers import T5Config, T5EncoderModel

    torch.manual_seed(0)
    transformer = FluxTransformer2DModel(
        **_FLUX,
        joint_attention_dim=32,
        pooled_projection_dim=16,
        axes_dims_rope=(4, 4, 8),
        guidance_embeds=True,
    )
    vae = AutoencoderKL(
        **_VAE, use_quant_conv=False, use_post_quant_conv=False, shift_factor=0.1, scaling_factor=0.4
    )
    t5 = T5EncoderModel(
        T5Config(vocab_size=64, d_model=32, d_kv=8, d_ff=16, num_layers=1, num_heads=2)
    ).eval()
    pipeline = FluxKontextPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(),
        vae=vae.eval(),
        text_encoder=_clip(16),
        tokenizer=clip_tokenizer(folder / "words"),
        text_encoder_2=t5,
        tokenizer_2=_t5_tokenizer(),
        transformer=transformer.eval(),
    )
    return _saved(pipeline, folder)


def tiny_flux2_klein(folder: Path) -> Path:
    """A Flux2KleinPipeline of about 100 000 parameters in `folder`."""
    from diffusers import (
        AutoencoderKLFlux2,
        FlowMatchEulerDiscreteScheduler,
        Flux2KleinPipeline,
        Flux2Transformer2DModel,
    )
    from transformers import Qwen3Config, Qwen3ForCausalLM

    torch.manual_seed(0)
    layers = 28  # the pipeline reads hidden states 9, 18 and 27
    text = Qwen3ForCausalLM(
        Qwen3Config(
            vocab_size=160,
            hidden_size=16,
            intermediate_size=16,
            num_hidden_layers=layers,
            num_attention_heads=2,
            num_key_value_heads=2,
            head_dim=8,
        )
    ).eval()
    transformer = Flux2Transformer2DModel(
        **_FLUX,
        joint_attention_dim=48,
        timestep_guidance_channels=16,
        axes_dims_rope=(4, 4, 4, 4),
        guidance_embeds=False,
    )
    vae = AutoencoderKLFlux2(**_VAE, layers_per_block=1, sample_size=32)
    pipeline = Flux2KleinPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(),
        vae=vae.eval(),
        text_encoder=text,
        tokenizer=_qwen_tokenizer(folder / "words"),
        transformer=transformer.eval(),
        is_distilled=True,
    )
    return _saved(pipeline, folder)


def _saved(pipeline: Any, folder: Path) -> Path:
    pipeline.save_pretrained(folder / "pipeline")
    return folder / "pipeline"


def _clip(width: int) -> Any:
    from transformers import CLIPTextConfig, CLIPTextModel

    return CLIPTextModel(
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
