"""`progdf bench rasterize`: the cpu engine's speed beside its error, against a tiled renderer in plain torch.

What it is compared with is the reference engine in float32: dense within tiles of 16x16 pixels that the
box around a Gaussian's {alpha ≥ 1/255} touches, differentiated by autograd. Both take turns in one process,
on one thread each: torch's threads wait for each other by spinning, which on a busy machine would flatter
ours by any factor.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from progdf.bench import Table
from progdf.camera import Camera, intrinsics
from progdf.rasterize import rasterize, set_threads

INPUTS = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class Case:
    """A random cloud in front of a camera.

    Args:
        count: Gaussians
        size: width and height of the image, pixels
        baseline: whether torch can do it in the memory of a small machine
    """

    count: int
    size: int
    baseline: bool = True


CASES = (Case(2_000, 128), Case(20_000, 256), Case(100_000, 512, baseline=False))


@dataclass(frozen=True)
class Result:
    """Times of one case in ms, one entry a round, and errors against float64.

    Args:
        forward, both: the cpu engine without and with the backward pass, on all threads
        one_thread: the cpu engine with the backward pass on one thread; medians
        torch_one_thread: the tiled torch renderer likewise; empty where it is left out
        image_error: largest difference of a colour
        gradient_errors: largest difference over the largest gradient, by input
    """

    case: Case
    forward: list[float]
    both: list[float]
    one_thread: list[float]
    torch_one_thread: list[float]
    image_error: float
    gradient_errors: dict[str, float]

    @property
    def ratio(self) -> float:
        """How many times faster than torch; the median over the rounds of each round's ratio."""
        return statistics.median(b / a for a, b in zip(self.one_thread, self.torch_one_thread, strict=True))


def cloud(case: Case) -> tuple[list[Tensor], Camera]:
    """Activated means, quats, scales, opacities, rgb, seeded, and a camera that sees most of them.

    A Gaussian's standard deviation is about 1.4 pixels, axes differ by a factor of about 2: what a trained
    scene looks like from where its pictures were taken.
    """
    rng = torch.Generator().manual_seed(case.count)
    means = torch.randn(case.count, 3, generator=rng) * 0.7 + torch.tensor([0.0, 0.0, 4.0])
    K = intrinsics(0.9, case.size, case.size)
    scale = 1.4 * 4.0 / float(K[0, 0])
    scales = scale * torch.exp(0.5 * torch.randn(case.count, 3, generator=rng))
    quats = torch.randn(case.count, 4, generator=rng)
    opacities = torch.sigmoid(1.5 * torch.randn(case.count, generator=rng))
    colors = torch.rand(case.count, 3, generator=rng)
    return [means, quats, scales, opacities, colors], Camera(torch.eye(4), K, case.size, case.size)


def draw(
    inputs: list[Tensor], camera: Camera, engine: str, dtype: torch.dtype, backward: bool
) -> tuple[float, Tensor, list[Tensor]]:
    """Milliseconds of one pass, the image, and the gradients of its difference from a smooth target."""
    leaves = [tensor.clone().to(dtype).requires_grad_(backward) for tensor in inputs]
    means, quats, scales, opacities, colors = leaves
    ramp = torch.linspace(0.0, pi, camera.width, dtype=dtype).sin()
    target = (ramp[:, None] * ramp)[..., None].expand(-1, -1, 3)
    begin = time.perf_counter()
    image, _, _ = rasterize(
        means, quats, scales, opacities, colors, camera.viewmat, camera.K, camera.width, camera.height,
        engine=engine,
    )  # fmt: skip
    if backward:
        (image - target).square().sum().backward()  # type: ignore[no-untyped-call]
    elapsed = 1e3 * (time.perf_counter() - begin)
    return elapsed, image.detach(), [leaf.grad for leaf in leaves if leaf.grad is not None]


def measure(case: Case, rounds: int = 9, torch_rounds: int = 3) -> Result:
    """Measure one case; engines take turns, and the first round of each is not counted.

    Args:
        case: what to draw
        rounds: of the cpu engine, within each round of torch
        torch_rounds: of torch
    """
    inputs, camera = cloud(case)
    _, image, gradients = draw(inputs, camera, "cpu", torch.float32, backward=True)
    draw(inputs, camera, "cpu", torch.float32, backward=False)
    forward = [draw(inputs, camera, "cpu", torch.float32, backward=False)[0] for _ in range(rounds)]
    both = [draw(inputs, camera, "cpu", torch.float32, backward=True)[0] for _ in range(rounds)]
    one_thread, torch_one_thread = [], []
    if case.baseline:
        with _one_thread():
            draw(inputs, camera, "reference", torch.float32, backward=True)
            for _ in range(torch_rounds):
                fast = [draw(inputs, camera, "cpu", torch.float32, backward=True)[0] for _ in range(rounds)]
                one_thread.append(statistics.median(fast))
                torch_one_thread.append(draw(inputs, camera, "reference", torch.float32, backward=True)[0])
    with torch.set_grad_enabled(case.baseline):
        _, exact, exact_gradients = draw(inputs, camera, "reference", torch.float64, backward=case.baseline)
    errors = {
        name: float((found - expected).abs().max() / expected.abs().max())
        for name, found, expected in zip(INPUTS, gradients, exact_gradients, strict=False)
    }
    image_error = float((image - exact).abs().max())
    return Result(case, forward, both, one_thread, torch_one_thread, image_error, errors)


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    set_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        set_threads(None)


def tables() -> list[Table]:
    """The benchmark's table."""
    results = [measure(case) for case in CASES]
    rows = []
    for result in results:
        case = result.case
        worst = max(result.gradient_errors, key=lambda name: result.gradient_errors[name], default="")
        rows.append(
            (
                f"{case.count:,}".replace(",", " "),
                f"{case.size}²",
                _spread(result.forward),
                _spread(result.both),
                _spread(result.one_thread) if case.baseline else "not run",
                _spread(result.torch_one_thread) if case.baseline else "not run",
                f"{result.ratio:.0f}×" if case.baseline else "not run",
                f"{result.image_error:.1e}",
                f"{result.gradient_errors[worst]:.1e} ({worst})" if worst else "not run",
            )
        )
    columns = (
        "Gaussians",
        "pixels",
        "forward (ms)",
        "forward + backward (ms)",
        "the same on one thread (ms)",
        "torch on one thread (ms)",
        "ratio",
        "image error",
        "worst gradient error",
    )
    note = (
        "Median and range; the engines take turns in one process. Errors are against float64: largest "
        "difference of a colour; largest difference of a gradient over the largest, worst input named."
    )
    return [Table("rasterize", "CPU rasteriser", columns, tuple(rows), note)]


def _spread(times: list[float]) -> str:
    return f"{statistics.median(times):.1f} ({min(times):.1f}-{max(times):.1f})"
