"""Editor `instruct:"turn him into Batman"`: pictures edited by a text instruction, at any strength.

Every view is rendered again for the model (`FramePainter`). InstructPix2Pix is the editor of the ProGDF
paper. The other models are newer and larger (`adapters`). The models have no parameter for the strength:
`mixed_steps` adds it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from functools import cache

from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians
from progdf.io.picture_camera import find_picture_camera
from progdf.metrics.image import round_to_8_bits
from progdf.scene.regions import read_numbers
from trainer.options import EditKind, EditorOptions
from trainer.store.pretrained import last_model
from trainer.views.view import View

from . import adapters
from .adapters import DevicePlan, PipelineRequest
from .base import EditorInput
from .cache import PictureCache, Recipe
from .mixed_steps import MixedSteps, network_steps
from .painter import FramePainter, PaintRequest

IMAGE_SIZE = 512
"""Longer side of the views, pixels, downscaled from the model's own size."""


@dataclass(frozen=True)
class InstructEditor(FramePainter):
    """Editor of views by a text instruction. In each view it paints the region and its surroundings."""

    scene: Gaussians
    request: PipelineRequest
    placement: DevicePlan
    load: Callable[[], MixedSteps]  # loads the pipeline on first use
    kept: PictureCache
    stages: tuple[float, ...] = ()
    kind: EditKind = "style"
    is_confined: bool = False
    _renders: dict[str, Tensor] = field(default_factory=dict, repr=False)

    has_start = True
    has_strength = True

    @property
    def size(self) -> int:
        """Side of a square with the painted area, pixels."""
        return self.request.size

    @property
    def references(self) -> int:
        """Number of reference pictures that one call accepts beside the view."""
        return self.request.adapter.references

    def paint_size(self, width: float, height: float) -> tuple[int, int]:
        """See `FramePainter.paint_size`."""
        return self.request.adapter.paint_size(width, height, self.request.size)

    @property
    def recipe(self) -> Recipe:
        """All inputs of a picture except its source and strength."""
        values = {f.name: getattr(self.request, f.name) for f in fields(self.request)}
        return {"instruct": values.pop("prompt")} | {k: v for k, v in values.items() if k != "adapter"}

    @property
    def note(self) -> str:
        """Model, device, memory and network calls per picture, for the log."""
        request = self.request
        ignored = unread_words(self.request)
        line = f"{request.model} {self.placement.line()}; {self.calls((1.0,))} network calls per picture"
        return f"{line}; it ignores the end of the prompt: “{ignored}”" if ignored else line

    def calls(self, strengths: Sequence[float]) -> int:
        """Return the number of network calls for one view at these strengths."""
        request = self.request
        return request.adapter.passes * sum(network_steps(s, 1.0, request.steps) for s in strengths)

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        if strength == 0.0:
            return view.image
        painted = self.kept.picture(
            view.camera.name,
            self.original(view),
            {**self.recipe, "strength": strength},
            lambda picture: self.paint(PaintRequest(picture, strength=strength)),
            "" if strength == 1.0 else f"{strength:g}",
        )
        return self.paste(view, painted)

    def paint(self, request: PaintRequest) -> Tensor:
        """See `FramePainter.paint`.

        Raises:
            ProgdfError: weights are missing or broken, or the GPU runs out of memory.
        """
        model = self.request
        count = len(request.references)
        if count > self.references:
            raise ValueError(f"{model.model} accepts {self.references} references, not {count}")
        noise = model.seed if request.seed is None else request.seed
        with adapters.explain_memory(model, self.placement):
            painted = self.load().paint(
                lambda pictures: model.ask(pictures, noise),
                (request.picture, *request.references),
                request.picture if request.source is None else request.source,
                request.strength,
                request.softness,
            )
        return round_to_8_bits(painted)


def instruct(given: EditorInput) -> InstructEditor:
    """Return the editor of `instruct:"…"`.

    The model and its options are checked now. Weights are loaded on first use.
    """
    options = given.options
    request = resolve_request(given.what, options)

    @cache
    def pipeline() -> MixedSteps:
        # choose the device again: the previous model is unloaded by now
        return last_model(
            "pipeline",
            (request, options.device),
            lambda: adapters.load_pipeline(request, adapters.place(request, options.device)),
        )

    placement = adapters.place(request, options.device)
    return InstructEditor(given.scene, request, placement, pipeline, PictureCache(options.cache))


def check_instruct(what: str, options: EditorOptions) -> None:
    """Check everything that `instruct` and its pipeline need, without loading a network.

    Raises:
        ProgdfError: the instruction is empty; a package or weights are missing or truncated; an option does
            not apply; the anchor is not a picture or has no camera; or there is an anchor and the model
            accepts no reference pictures.
    """
    request = resolve_request(what, options)
    adapters.place(request, options.device)
    if options.anchor is not None:
        find_picture_camera(options.anchor, origin=ZERO)
        if not request.adapter.references:
            raise ProgdfError(
                f"{request.model} accepts no reference pictures and cannot follow --anchor; leave it out, "
                f"use --model {adapters.ADAPTERS['Flux2KleinPipeline'].model}, or train that picture alone "
                f"with --editor pictures:{options.anchor}"
            )


def sentence(what: str) -> str:
    """Return the instruction without the pair of quotes around it."""
    words = what.strip()
    if len(words) > 1 and words[0] == words[-1] and words[0] in "\"'":
        words = words[1:-1].strip()
    return words


def resolve_request(what: str, options: EditorOptions) -> PipelineRequest:
    """Return the request of the options, with the model's defaults for options that are not set.

    Raises:
        ProgdfError: see `check_instruct`.
    """
    prompt = sentence(what)
    if not prompt:
        raise ProgdfError('instruct: needs an instruction; write instruct:"turn him into Batman"')
    model = options.model or adapters.default_model()
    kind, adapter = adapters.adapter_of(model)
    guidance, image_guidance = parse_guidance(options.guidance)
    if image_guidance is not None and adapter.image_guidance is None:
        raise ProgdfError(
            f"{model} does not support picture guidance; give one number with --guidance, "
            f"or use --model {adapters.SMALL_MODEL}"
        )
    for is_given, option in (
        (guidance is not None and adapter.guidance is None, "--guidance"),
        (options.edit_size is not None and adapter.is_fixed, "--edit-size"),
    ):
        if is_given:
            raise ProgdfError(f"{option} does not apply to {model}, which has a fixed value; leave it out")
    return PipelineRequest(
        prompt,
        model,
        kind,
        adapter,
        steps=adapter.steps if options.edit_steps is None else options.edit_steps,
        guidance=adapter.guidance if guidance is None else guidance,
        image_guidance=adapter.image_guidance if image_guidance is None else image_guidance,
        size=adapter.size if options.edit_size is None else options.edit_size,
        seed=options.seed,
        quantize=options.quantize,
    )


def unread_words(request: PipelineRequest) -> str:
    """Return the end of the prompt beyond CLIP's 77 tokens if CLIP is the only text encoder, else ""."""
    if not request.adapter.is_stable:
        return ""
    from transformers import CLIPTokenizer

    tokenizer = CLIPTokenizer.from_pretrained(adapters.pipeline_folder(request.model) / "tokenizer")
    tokens = tokenizer(request.prompt)["input_ids"]
    return str(tokenizer.decode(tokens[tokenizer.model_max_length - 1 : -1])).strip()


def parse_guidance(text: str) -> tuple[float | None, float | None]:
    """Return the guidance for the instruction and for the picture from `--guidance`; None if not given.

    Raises:
        ProgdfError: the text is neither one nor two numbers between 1 and 100.
    """
    numbers = read_numbers(text)
    if text and (len(numbers) not in (1, 2) or not all(1 <= number <= 100 for number in numbers)):
        raise ProgdfError(
            f"--guidance must be one or two numbers between 1 and 100, such as 7.5,1.5; got {text}"
        )
    sentence, picture = (*numbers, None, None)[:2]
    return sentence, picture
