"""One table: how each pipeline of diffusers is asked to edit a picture. They differ in little but names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from PIL import Image

_FLOW = {
    "steps": "num_inference_steps",
    "guidance": "guidance_scale",
    "width": "width",
    "height": "height",
}


@dataclass(frozen=True)
class Adapter:
    """How one pipeline is asked.

    Args:
        model: the id of its weights on the Hugging Face hub
        words: our word → its keyword, of steps, guidance (how closely the instruction is followed),
            image_guidance (how closely the picture is), width, height, area
        steps, guidance, image_guidance: the values it was made for
        size: longer side in pixels at which it was made to paint
        dtype: of its weights on a CPU
        always: further arguments of a call
        loading: further arguments of its from_pretrained
        needs: packages that it needs besides the extra's
    """

    model: str
    words: Mapping[str, str]
    steps: int
    guidance: float
    size: int
    dtype: torch.dtype
    image_guidance: float | None = None
    always: Mapping[str, object] = field(default_factory=dict)
    loading: Mapping[str, object] = field(default_factory=dict)
    needs: tuple[str, ...] = ()

    def arguments(
        self, prompt: str, picture: Image.Image, steps: int, guidance: float, image_guidance: float | None
    ) -> dict[str, object]:
        """Keyword arguments of a call, all but its `generator`."""
        ours = {
            "steps": steps,
            "guidance": guidance,
            "image_guidance": image_guidance,
            "width": picture.width,
            "height": picture.height,
            "area": picture.width * picture.height,
        }
        theirs = {word: ours[name] for name, word in self.words.items()}
        return {"prompt": prompt, "image": picture, **theirs, **self.always}


ADAPTERS: dict[str, Adapter] = {
    # ProGDF's own; the result has the picture's size
    "StableDiffusionInstructPix2PixPipeline": Adapter(
        model="timbrooks/instruct-pix2pix",
        words={
            "steps": "num_inference_steps",
            "guidance": "guidance_scale",
            "image_guidance": "image_guidance_scale",
        },
        steps=20,
        guidance=7.5,
        image_guidance=1.5,
        size=512,
        dtype=torch.float32,
        loading={"safety_checker": None, "requires_safety_checker": False},
    ),
    "FluxKontextPipeline": Adapter(
        model="black-forest-labs/FLUX.1-Kontext-dev",
        words={**_FLOW, "area": "max_area"},
        steps=28,
        guidance=2.5,
        size=1024,
        dtype=torch.bfloat16,
        # it would scale every picture to about a megapixel; ours comes at the size that was asked for
        always={"_auto_resize": False},
    ),
    "Flux2KleinPipeline": Adapter(
        model="black-forest-labs/FLUX.2-klein-4B",
        words=_FLOW,
        steps=4,
        guidance=1.0,
        size=1024,
        dtype=torch.bfloat16,
    ),
    "QwenImageEditPlusPipeline": Adapter(
        model="Qwen/Qwen-Image-Edit-2509",
        words={**_FLOW, "guidance": "true_cfg_scale"},
        steps=40,
        guidance=4.0,
        size=1024,
        dtype=torch.bfloat16,
        always={"negative_prompt": " "},  # without one it has no guidance at all
        needs=("torchvision",),
    ),
}
"""Class name in diffusers, as a saved pipeline's model_index.json has it → how it is asked."""

DEFAULT_MODEL = ADAPTERS["StableDiffusionInstructPix2PixPipeline"].model
