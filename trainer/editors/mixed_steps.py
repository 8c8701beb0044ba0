"""Source-mixed sampling: an edit at any strength with any diffusers pipeline.

    p ← w p + (1 − w) p_src,     w_i(s) = clip((s (1 + soft) − (1 − i/n)) / soft, 0, 1),     i = 0..n − 1

p is the network's prediction at step i of n. p_src = (x − src) / σ is the prediction that leads straight to
the source, both for a flow's velocity and for Euler's noise. At strength 0 all steps lead to the source. At
strength 1 no step is changed, so the picture equals the stock pipeline's bit for bit. The source is captured
among the pipeline's own latents, so one implementation serves all pipelines, whatever their packing. Steps
with weight 0 skip the network.

Reasons for softness 1: docs/lab/experiments.md, The degree of a text edit.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

_EULER = ("FlowMatchEulerDiscreteScheduler", "EulerAncestralDiscreteScheduler", "EulerDiscreteScheduler")


def step_weight(strength: float, softness: float, progress: float) -> float:
    """Return the weight of the model's prediction in the step that begins at `progress` = i/n, 0..1."""
    return min(1.0, max(0.0, (strength * (1.0 + softness) - (1.0 - progress)) / softness))


def network_steps(strength: float, softness: float, steps: int) -> int:
    """Return the number of steps that run the network."""
    return sum(step_weight(strength, softness, i / steps) > 0.0 for i in range(steps))


class _EncodedError(Exception):
    """Signal that the prompt is encoded and the rest of the call can be skipped."""


class MixedSteps:
    """A pipeline with mixed steps. Make it before anything else wraps the pipeline's network.

    Args:
        pipeline: pipeline of diffusers, with an Euler scheduler (`euler_scheduler`)
        encodes_alone: encode the prompt once, without the picture (see `encode`)
    """

    def __init__(self, pipeline: Any, encodes_alone: bool) -> None:
        self.pipeline = pipeline
        self.calls = 0  # network calls so far
        self._strength = 1.0
        self._softness = 1.0
        self._step = 0
        self._source: Tensor | None = None  # latents of the result at strength 0, as the pipeline packs them
        self.latents: Tensor | None = None  # latents of the last call's pictures, as packed
        self._encoding = False
        self._prepares_images_apart = hasattr(pipeline, "prepare_image_latents")
        network = pipeline.transformer if hasattr(pipeline, "transformer") else pipeline.unet
        for owner, name, wrap in (
            (network, "forward", self._skip),
            (pipeline.scheduler, "step", self._mix),
            (pipeline, "prepare_latents", self._catch),
            (pipeline, "prepare_image_latents", self._catch),
            (pipeline, "encode_prompt" if hasattr(pipeline, "encode_prompt") else "_encode_prompt", _once),
        ):
            if hasattr(owner, name) and (wrap is not _once or encodes_alone):
                inner = getattr(owner, name)
                setattr(owner, name, functools.wraps(inner)(wrap(inner)))

    def encode(self, arguments: Mapping[str, object]) -> None:
        """Encode the prompt of these arguments and stop the pipeline there."""
        self._encoding = True
        with suppress(_EncodedError):
            self.pipeline(**arguments)
        self._encoding = False

    def paint(
        self,
        ask: Callable[[Sequence[Tensor]], Mapping[str, object]],
        pictures: Sequence[Tensor],
        source: Tensor,
        strength: float,
        softness: float,
    ) -> Tensor:
        """Return the pipeline's result at a strength. [H,W,3] each -> [H,W,3] 0..1

        The autoencoder's error on the source is subtracted in proportion to 1 − strength, so that the result
        is continuous at strength 0.

        Args:
            ask: returns the arguments of a call for given pictures, with the same noise each time
            pictures: the view's own first, then references
            source: result at strength 0
            strength, softness: see `InstructEditor.paint`
        """
        if strength <= 0.0:
            return source
        if strength >= 1.0:
            return self._run(ask(pictures), 1.0, softness)
        decoded = self._run(ask([source]), 0.0, softness)
        self._source = self.latents
        mixed = self._run(ask(pictures), strength, softness)
        return (mixed + (1.0 - strength) * (source - decoded)).clamp(0.0, 1.0)

    def _run(self, arguments: Mapping[str, object], strength: float, softness: float) -> Tensor:
        self._strength = strength
        self._softness = softness
        self._step = 0
        try:
            images: Tensor = self.pipeline(**arguments, output_type="pt").images
        finally:
            self._source = None
        return images[0].float().cpu().permute(1, 2, 0)

    def _weight(self) -> float:
        steps = len(self.pipeline.scheduler.timesteps)
        return step_weight(self._strength, self._softness, self._step / steps)

    def _catch(self, inner: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a method that prepares latents, to store the latents of the pictures.

        Pipelines prepare them in a method of their own or together with the noise.
        """
        of_pictures = inner.__name__ == "prepare_image_latents"

        def prepare(*args: Any, **kwargs: Any) -> Any:
            if self._encoding:
                raise _EncodedError
            prepared = inner(*args, **kwargs)
            if of_pictures:
                self.latents = prepared if isinstance(prepared, Tensor) else prepared[0]
            elif not self._prepares_images_apart:
                self.latents = prepared[1]
            return prepared

        return prepare

    def _skip(self, inner: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap the network, to run it only if its weight is above 0 or later steps need its cache."""

        def forward(*args: Any, **kwargs: Any) -> Any:
            if self._weight() > 0.0 or kwargs.get("kv_cache_mode") == "extract":
                self.calls += 1
                return inner(*args, **kwargs)
            given: Tensor = args[0] if args else kwargs["hidden_states"]
            return (given,)  # has the right shape; the value is not used

        return forward

    def _mix(self, inner: Callable[..., Any]) -> Callable[..., Any]:
        def step(predicted: Tensor, timestep: Any, sample: Tensor, *args: Any, **kwargs: Any) -> Any:
            weight = self._weight()
            if weight < 1.0:
                straight = self._straight(sample.float()).to(predicted.dtype)
                predicted = torch.lerp(straight, predicted, weight) if weight > 0.0 else straight
            self._step += 1
            return inner(predicted, timestep, sample, *args, **kwargs)

        return step

    def _straight(self, sample: Tensor) -> Tensor:
        """Return the prediction that leads from a sample straight to the source."""
        latents = self.latents if self._source is None else self._source
        assert latents is not None
        # latents of a UNet are planes: those of the picture come first, unscaled as in the autoencoder
        if sample.ndim == 4:
            is_scaled = getattr(self.pipeline, "is_cosxl_edit", False)
            scale = 1.0 if is_scaled else self.pipeline.vae.config.scaling_factor
            source = latents[: len(sample)].float() * scale
        else:  # tokens; those of references follow
            source = latents[:, : sample.shape[1]].float()
        scheduler = self.pipeline.scheduler
        sigma: Tensor = scheduler.sigmas[self._step].to(sample.device)
        if getattr(scheduler.config, "prediction_type", "") == "v_prediction":
            root = (sigma**2 + 1).sqrt()
            sample = sample / root
            source = source * root
        return (sample - source) / sigma


def _once(inner: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a text encoder, to encode each prompt once. Its weights can be unloaded afterwards."""
    encodings: dict[str, Any] = {}

    def encode(*args: Any, **kwargs: Any) -> Any:
        device = next(value for value in (*args, *kwargs.values()) if isinstance(value, torch.device))
        words = [value for value in (*args, *kwargs.values()) if isinstance(value, str | bool | list)]
        if repr(words) not in encodings:
            encodings[repr(words)] = inner(*args, **kwargs)
        encoded = encodings[repr(words)]
        if isinstance(encoded, Tensor):
            return encoded.to(device)
        return tuple(part.to(device) if isinstance(part, Tensor) else part for part in encoded)

    return encode


def euler_scheduler(pipeline: Any) -> Any:
    """Return the pipeline's scheduler if it is Euler's, else an Euler scheduler with the same settings.

    Mixed steps of DDIM are not monotone in the strength.
    """
    import diffusers

    if type(pipeline.scheduler).__name__ in _EULER:
        return pipeline.scheduler
    kind = _EULER[0] if hasattr(pipeline, "transformer") else _EULER[1]
    return getattr(diffusers, kind).from_config(pipeline.scheduler.config)
