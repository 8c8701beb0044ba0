"""The source-mixed step: an edit at any degree, by any pipeline of diffusers.

    p ← w p + (1 − w) p_src,     w_i(s) = clip((s (1 + soft) − (1 − i/n)) / soft, 0, 1),     i = 0..n − 1

p is what the network predicts at step i of n, p_src what would lead straight to the source: (x − src) / σ,
of a flow's velocity and of Euler's noise alike. At strength 0 all steps lead to the source; at 1 none is
touched, so that the picture is the stock pipeline's to the bit. The source is caught among the pipeline's own
latents: one implementation does for all pipelines, however they pack. Steps whose weight is 0 ask no network.
Why softness 1: docs/experiments.md, The degree of a text edit.
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
    """The model's say in the step that begins at `progress` = i/n, 0..1."""
    return min(1.0, max(0.0, (strength * (1.0 + softness) - (1.0 - progress)) / softness))


def network_steps(strength: float, softness: float, steps: int) -> int:
    """In how many of the steps a network is asked."""
    return sum(step_weight(strength, softness, i / steps) > 0.0 for i in range(steps))


class _EncodedError(Exception):
    """The sentence is encoded: nothing further is wanted of this call."""


class MixedSteps:
    """A pipeline whose steps can be mixed; made once, before anything else wraps the pipeline's network.

    Args:
        pipeline: of diffusers, with a scheduler of Euler's (`euler_scheduler`)
        encodes_alone: its sentence is encoded without the picture: once, see `encode`
    """

    def __init__(self, pipeline: Any, encodes_alone: bool) -> None:
        self.pipeline = pipeline
        self.calls = 0  # of the network, so far
        self._strength = 1.0
        self._softness = 1.0
        self._step = 0
        self._source: Tensor | None = None  # latents that strength 0 ends in, as the pipeline packs them
        self.latents: Tensor | None = None  # of the pictures that the last call was given, as packed
        self._encoding = False
        self._has_own = hasattr(pipeline, "prepare_image_latents")
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
        """Encode the sentence of these arguments, and nothing else."""
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
        """What the pipeline makes of its pictures, at a strength. [H,W,3] each -> [H,W,3] 0..1

        What its autoencoder loses of the source is added in the source's share: nothing jumps at 0.

        Args:
            ask: pictures -> the arguments of a call; the same noise each time
            pictures: the view's own first
            source: what strength 0 gives
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
        """Keep the latents of the pictures: a pipeline prepares them apart, or beside the noise."""
        of_pictures = inner.__name__ == "prepare_image_latents"

        def prepare(*args: Any, **kwargs: Any) -> Any:
            if self._encoding:
                raise _EncodedError
            made = inner(*args, **kwargs)
            if of_pictures:
                self.latents = made if isinstance(made, Tensor) else made[0]
            elif not self._has_own:
                self.latents = made[1]
            return made

        return prepare

    def _skip(self, inner: Callable[..., Any]) -> Callable[..., Any]:
        """Ask the network only where it has a say, or where later steps need what it remembers."""

        def forward(*args: Any, **kwargs: Any) -> Any:
            if self._weight() > 0.0 or kwargs.get("kv_cache_mode") == "extract":
                self.calls += 1
                return inner(*args, **kwargs)
            given: Tensor = args[0] if args else kwargs["hidden_states"]
            return (given,)  # of the right shape, and never looked at

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
        """The prediction that leads from a sample straight to the source."""
        latents = self.latents if self._source is None else self._source
        assert latents is not None
        if sample.ndim == 4:  # planes, of a UNet: the picture's come first, and as the autoencoder has them
            is_scaled = getattr(self.pipeline, "is_cosxl_edit", False)
            scale = 1.0 if is_scaled else self.pipeline.vae.config.scaling_factor
            source = latents[: len(sample)].float() * scale
        else:  # tokens; those of further pictures follow
            source = latents[:, : sample.shape[1]].float()
        scheduler = self.pipeline.scheduler
        sigma: Tensor = scheduler.sigmas[self._step].to(sample.device)
        if getattr(scheduler.config, "prediction_type", "") == "v_prediction":
            root = (sigma**2 + 1).sqrt()
            sample = sample / root
            source = source * root
        return (sample - source) / sigma


def _once(inner: Callable[..., Any]) -> Callable[..., Any]:
    """Encode each sentence once; then its encoder may go."""
    made: dict[str, Any] = {}

    def encode(*args: Any, **kwargs: Any) -> Any:
        device = next(value for value in (*args, *kwargs.values()) if isinstance(value, torch.device))
        words = [value for value in (*args, *kwargs.values()) if isinstance(value, str | bool | list)]
        if repr(words) not in made:
            made[repr(words)] = inner(*args, **kwargs)
        encoded = made[repr(words)]
        if isinstance(encoded, Tensor):
            return encoded.to(device)
        return tuple(part.to(device) if isinstance(part, Tensor) else part for part in encoded)

    return encode


def euler_scheduler(pipeline: Any) -> Any:
    """The pipeline's scheduler, or Euler's of the same settings: mixed steps of DDIM's are not monotone."""
    import diffusers

    if type(pipeline.scheduler).__name__ in _EULER:
        return pipeline.scheduler
    kind = _EULER[0] if hasattr(pipeline, "transformer") else _EULER[1]
    return getattr(diffusers, kind).from_config(pipeline.scheduler.config)
