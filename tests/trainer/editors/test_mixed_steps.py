"""Source-mixed steps in tiny pipelines of every class."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from progdf.io.images import to_picture
from tests.helpers.tiny_pipelines import PIPELINES, small_megapixels
from trainer.editors.adapters import ADAPTERS
from trainer.editors.mixed_steps import MixedSteps, euler_scheduler, network_steps, step_weight

SIDE = 64
STEPS = 4
KINDS = list(PIPELINES)
ROUNDING = 1e-5  # tolerance for a picture decoded twice; latents agree to 1e-6

Ask = Callable[[Sequence[Tensor]], dict[str, object]]


@pytest.fixture(scope="module", autouse=True)
def small_pictures() -> Iterator[None]:
    for package in ("diffusers", "transformers", "accelerate"):
        pytest.importorskip(package, reason="pip install progdf-studio[diffusion]")
    with small_megapixels(SIDE):
        yield
    made.cache_clear()


def asking(kind: str, steps: int = STEPS) -> Ask:
    import diffusers

    adapter = ADAPTERS[kind]

    def ask(pictures: Sequence[Tensor]) -> dict[str, object]:
        shown = [to_picture(picture) for picture in pictures]
        known = signature(getattr(diffusers, kind).__call__).parameters
        arguments = adapter.arguments(
            known, "as Batman", shown, steps, adapter.guidance, adapter.image_guidance
        )
        return arguments | {"generator": torch.Generator().manual_seed(3)}

    return ask


@cache
def made(kind: str, folder: Path) -> tuple[MixedSteps, Tensor]:
    """Return a pipeline with mixed steps, and its picture of `view()` without them."""
    pipeline = PIPELINES[kind](folder)
    pipeline.set_progress_bar_config(disable=True)
    stock = pipeline(**asking(kind)([view()]), output_type="pt").images[0].permute(1, 2, 0)
    return MixedSteps(pipeline, ADAPTERS[kind].encodes_alone), stock


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pipelines")


def view(shift: float = 0.0) -> Tensor:
    """Return smooth colors, rounded to 8 bits. [64,64,3]"""
    ramp = torch.linspace(0, 1, SIDE)
    image = torch.stack(
        [ramp.expand(SIDE, SIDE), ramp[:, None].expand(SIDE, SIDE), ramp.flip(0) * ramp[:, None]], -1
    )
    return ((image + shift).clamp(0, 1) * 255).round() / 255


def paint(mixed: MixedSteps, kind: str, strength: float, softness: float = 1.0) -> Tensor:
    return mixed.paint(asking(kind), [view()], view(), strength, softness)


def test_strength_one_is_bit_identical_to_the_stock_pipeline(kind: str, folder: Path) -> None:
    mixed, stock = made(kind, folder)
    paint(mixed, kind, 0.5)  # must leave no state behind
    assert torch.equal(paint(mixed, kind, 1.0), stock)
    assert float((stock - view()).abs().mean()) > 0.05


def test_strength_zero_leads_every_step_to_the_source(
    kind: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mixed, _ = made(kind, folder)
    step = mixed.pipeline.scheduler.step
    last = []

    def spied(*args: Any, **kwargs: Any) -> Any:
        made = step(*args, **kwargs)
        last[:] = [made[0]]
        return made

    monkeypatch.setattr(mixed.pipeline.scheduler, "step", spied)
    before = mixed.calls
    painted = paint(mixed, kind, 1e-9)
    assert mixed.latents is not None
    (ended,) = last
    latents = mixed.latents[:, : ended.shape[1]] if ended.ndim == 3 else mixed.latents[:1]
    if ended.ndim == 4:
        latents = latents * mixed.pipeline.vae.config.scaling_factor
    assert float((ended - latents).abs().max()) < 1e-6 * float(latents.abs().max().clamp_min(1.0))
    assert float((painted - view()).abs().max()) < ROUNDING
    cache_calls = 2 if kind == "Flux2KleinKVPipeline" else 0  # it fills its cache in the first step
    assert mixed.calls - before == cache_calls
    assert torch.equal(paint(mixed, kind, 0.0), view())


def test_velocity_predictions_in_euler_steps_reach_the_source(folder: Path) -> None:
    kind = "StableDiffusionXLInstructPix2PixPipeline"
    pipeline = PIPELINES[kind](folder)
    pipeline.set_progress_bar_config(disable=True)
    scheduler = pipeline.scheduler
    pipeline.scheduler = scheduler.from_config(scheduler.config, prediction_type="v_prediction")
    mixed = MixedSteps(pipeline, encodes_alone=True)
    ended = pipeline(**asking(kind)([view()]), output_type="latent").images
    mixed._strength = 0.0
    mixed._step = 0
    led = pipeline(**asking(kind)([view()]), output_type="latent").images
    assert mixed.latents is not None
    latents = mixed.latents[:1] * pipeline.vae.config.scaling_factor
    assert float((led - latents).abs().max()) < 1e-6
    assert float((ended - latents).abs().max()) > 0.1


def test_change_grows_with_strength(kind: str, folder: Path) -> None:
    mixed, stock = made(kind, folder)
    whole = float((stock - view()).norm())
    shares = [float((paint(mixed, kind, s) - view()).norm()) / whole for s in (0.25, 0.5, 0.75)]
    assert 0.0 < shares[0] < shares[1] < shares[2] < 1.0


def test_steps_without_weight_skip_the_network(kind: str, folder: Path) -> None:
    mixed, _ = made(kind, folder)
    before = mixed.calls
    paint(mixed, kind, 0.25)
    extra = 2 if kind == "Flux2KleinKVPipeline" else 0
    assert network_steps(0.25, 1.0, STEPS) == 1
    assert mixed.calls - before == ADAPTERS[kind].passes + extra


def test_nine_strengths_need_178_network_steps_instead_of_252() -> None:
    assert sum(network_steps(i / 8, 1.0, 28) for i in range(9)) == 178
    assert sum(network_steps(i / 8, 0.25, 28) for i in range(9)) == 145
    assert {step_weight(1.0, soft, i / 28) for soft in (0.25, 1.0, 9.0) for i in range(28)} == {1.0}
    assert {step_weight(0.0, soft, i / 28) for soft in (0.25, 1.0, 9.0) for i in range(28)} == {0.0}


def test_strength_zero_ends_at_a_separate_source(kind: str, folder: Path) -> None:
    mixed, _ = made(kind, folder)
    other = view(0.2)
    ended = mixed.paint(asking(kind), [view()], other, 1e-9, 1.0)
    assert float((ended - other).abs().max()) < ROUNDING
    half = mixed.paint(asking(kind), [view()], other, 0.6, 0.25)
    assert not torch.equal(half, paint(mixed, kind, 0.6, 0.25))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if ADAPTERS[kind].references])
def test_reference_pictures_are_used_but_are_not_the_source(kind: str, folder: Path) -> None:
    mixed, stock = made(kind, folder)
    with_reference = [view(), view(0.4)]
    assert not torch.equal(mixed.paint(asking(kind), with_reference, view(), 1.0, 1.0), stock)
    assert (
        float((mixed.paint(asking(kind), with_reference, view(), 1e-9, 1.0) - view()).abs().max()) < ROUNDING
    )


@pytest.mark.parametrize("kind", [kind for kind in KINDS if ADAPTERS[kind].encodes_alone])
def test_prompt_is_encoded_once_and_its_encoder_can_be_freed(kind: str, folder: Path) -> None:
    pipeline = PIPELINES[kind](folder)
    pipeline.set_progress_bar_config(disable=True)
    _, stock = made(kind, folder)
    mixed = MixedSteps(pipeline, encodes_alone=True)
    mixed.encode(asking(kind)([torch.ones(SIDE, SIDE, 3)]))
    assert mixed.calls == 0
    for name in [name for name in pipeline.components if name.startswith("text_encoder")]:
        setattr(pipeline, name, None)
    assert torch.equal(mixed.paint(asking(kind), [view()], view(), 1.0, 1.0), stock)


def test_unsupported_schedulers_are_replaced_by_euler(folder: Path) -> None:
    from diffusers import DDIMScheduler, HeunDiscreteScheduler

    pipeline = PIPELINES["StableDiffusionInstructPix2PixPipeline"](folder)
    kept = pipeline.scheduler
    assert euler_scheduler(pipeline) is kept
    for other in (DDIMScheduler, HeunDiscreteScheduler):
        pipeline.scheduler = other.from_config(kept.config)
        assert type(euler_scheduler(pipeline)).__name__ == "EulerAncestralDiscreteScheduler"
