"""`python -m benchmarks rasterize`: the cpu engine's speed beside its error, against tiles in plain torch.

What it is compared with is a plain tiled renderer in float32, differentiated by autograd: tiles of 16x16
pixels, within which every listed Gaussian meets every pixel; listed is what the square of three standard
deviations of the longer axis touches, as published (Kerbl 2023). Both take turns in one process, on one
thread each and on two.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import pi

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics
from progdf.rasterize import reference, render, set_threads
from progdf.rasterize.engines import ActivatedGaussians, RasterView

from .table import Table, Wall

INPUTS = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class RasterCase:
    """A random cloud in front of a camera."""

    count: int  # Gaussians
    size: int  # width and height of the image, pixels
    baseline: bool = True  # whether torch can do it in the memory of a small machine


CASES = (RasterCase(2_000, 128), RasterCase(20_000, 256), RasterCase(100_000, 512, baseline=False))


THREADS = (1, 2)


@dataclass(frozen=True)
class Duel:
    """Times on so many threads, ms, by round; of torch forward + backward."""

    threads: int
    forward: list[float]  # the cpu engine's
    both: list[float]  # and with the backward pass
    processor: list[float]  # that this takes of all cores
    ours: list[float]  # medians of `both` beside torch, none where torch is not run
    torch: list[float]

    @property
    def ratio(self) -> float:
        """How many times faster than torch; the median over the rounds of each round's ratio."""
        return statistics.median(b / a for a, b in zip(self.ours, self.torch, strict=True))


@dataclass(frozen=True)
class RasterTimes:
    """Times of one case, and errors against float64."""

    case: RasterCase
    duels: list[Duel]  # on each of `THREADS`, against the tiled torch renderer where that is run
    plain: float  # processor ms of the plain version, which is the float64
    image_error: float  # largest difference of a color
    gradient_errors: dict[str, float]  # largest difference over the largest gradient, by input


def cloud(case: RasterCase) -> tuple[ActivatedGaussians, Camera]:
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
    activated = ActivatedGaussians(means, quats, scales, opacities, colors)
    return activated, Camera(torch.eye(4), K, case.size, case.size)


def draw(
    inputs: ActivatedGaussians, camera: Camera, engine: str, dtype: torch.dtype, backward: bool
) -> tuple[float, Tensor, list[Tensor]]:
    """Milliseconds of one pass, the image, and the gradients that a fixed gradient of the image leads to."""
    leaves = inputs.each(lambda tensor: tensor.clone().to(dtype).requires_grad_(backward))
    ramp = torch.linspace(0.0, pi, camera.width, dtype=dtype).sin()
    grad_image = torch.stack([ramp[:, None] * ramp, ramp[:, None] - ramp, -ramp * ramp[:, None]], -1)
    begin = time.perf_counter()
    image = _image(engine, leaves, camera)
    if backward:
        image.backward(grad_image)  # type: ignore[no-untyped-call]
    elapsed = 1e3 * (time.perf_counter() - begin)
    return elapsed, image.detach(), [leaf.grad for leaf in leaves.tensors if leaf.grad is not None]


def _image(engine: str, gaussians: ActivatedGaussians, camera: Camera) -> Tensor:
    black = gaussians.means.new_zeros(3)
    if engine != "tiled":
        return render(gaussians, camera, black, engine=engine).image
    view = RasterView.of(camera, gaussians)
    splats, _ = reference.project(gaussians, view)
    image, _ = reference.blend(three_sigma(splats), view.crop, black)
    return image


def three_sigma(splats: reference.ReferenceSplats) -> reference.ReferenceSplats:
    """With the published extents: a square of three standard deviations along the longer axis, whole pixels.

    They leave out what a Gaussian still adds between there and alpha = 1/255.
    """
    l11, l21, l22 = splats.whitening.detach().double().unbind(1)
    c = l22.square().reciprocal()
    det = c / l11.square()
    b = l21 * (det * c).sqrt()
    a = (det + b.square()) / c
    middle = 0.5 * (a + c)
    longest = middle + (middle.square() - det).clamp_min(0.0).sqrt()
    radius = (3.0 * longest.sqrt()).ceil().to(splats.extents.dtype)
    return replace(splats, extents=radius[:, None].expand(-1, 2))


def measure(case: RasterCase, rounds: int = 9, torch_rounds: int = 3) -> RasterTimes:
    """Measure one case; engines take turns, and the first round of each is not counted.

    Args:
        case: what to draw
        rounds: of the cpu engine, within each round of torch
        torch_rounds: of torch
    """
    inputs, camera = cloud(case)
    _, image, gradients = draw(inputs, camera, "cpu", torch.float32, backward=True)
    duels = []
    for threads in THREADS:
        duels.append(duel := Duel(threads, [], [], [], [], []))
        if case.baseline:
            with _threads(threads):
                draw(inputs, camera, "tiled", torch.float32, backward=True)
        for _ in range(torch_rounds):
            # the kernels have their own threads; torch's would only spin beside them
            with _threads(1, threads):
                duel.forward.extend(
                    draw(inputs, camera, "cpu", torch.float32, False)[0] for _ in range(rounds)
                )
                for _ in range(rounds):
                    used = time.process_time()
                    duel.both.append(draw(inputs, camera, "cpu", torch.float32, backward=True)[0])
                    duel.processor.append(1e3 * (time.process_time() - used))
            if case.baseline:
                duel.ours.append(statistics.median(duel.both[-rounds:]))
                with _threads(threads):
                    duel.torch.append(draw(inputs, camera, "tiled", torch.float32, backward=True)[0])
    used = time.process_time()
    with torch.set_grad_enabled(case.baseline):
        _, exact, exact_gradients = draw(inputs, camera, "reference", torch.float64, backward=case.baseline)
    plain = 1e3 * (time.process_time() - used)
    errors = {
        name: float((gradient - expected).abs().max() / expected.abs().max())
        for name, gradient, expected in zip(INPUTS, gradients, exact_gradients, strict=False)
    }
    image_error = float((image - exact).abs().max())
    return RasterTimes(case, duels, plain, image_error, errors)


@contextmanager
def _threads(of_torch: int, of_kernels: int | None = None) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(of_torch)
    set_threads(of_kernels)
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
        baseline = "not run" if not case.baseline else ""
        rows += [
            (
                f"{case.count:,}".replace(",", " "),
                f"{case.size}²",
                str(duel.threads),
                _spread(duel.forward),
                _spread(duel.both),
                f"{statistics.median(duel.processor):.1f}",
                baseline or _spread(duel.torch),
                baseline or f"{duel.ratio:.0f}×",
                f"{result.plain:.0f}",
                f"{result.image_error:.1e}",
                f"{result.gradient_errors[worst]:.1e} ({worst})" if worst else "not run",
            )
            for duel in result.duels
        ]
    columns = (
        "Gaussians",
        "pixels",
        "threads",
        Wall("forward (ms)"),
        Wall("forward + backward (ms)"),
        "of the processor (ms)",
        Wall("tiled torch (ms)"),
        "ratio",
        "plain version, of the processor (ms)",
        "image error",
        "worst gradient error",
    )
    note = (
        "Median and range; the engines take turns in one process. The plain version is "
        "`progdf.rasterize.reference` in float64, forward alone where no gradient error is given. Errors are "
        "against it: largest difference of a color; of a gradient over the largest, worst input named. Dense "
        "tiles of torch are the easy opponent: OpenSplat's CPU engine, in one run with an earlier engine of "
        "ours, took 4.5 to 8.9 times as long as that, its gradients of quats and scales being wrong."
    )
    return [Table("rasterize", "CPU rasterizer", columns, tuple(rows), note)]


def hard_tables() -> list[Table]:
    """What every engine must survive: the largest differences of the cpu engine from the reference."""
    from tests.helpers.drawn import CASES as HARD
    from tests.helpers.drawn import drawn_case, relative_errors

    rows = []
    for name, case in HARD.items():
        fast, plain = drawn_case(name, "cpu"), drawn_case(name, "reference")
        errors = relative_errors(fast, plain)
        worst = max(errors, key=lambda name: errors[name])
        apart = float((fast.image - plain.image).abs().max())
        where = f" ({worst})" if errors[worst] else ""
        count = f"{len(case.gaussians):,}".replace(",", " ")
        rows.append((name, count, f"{apart:.1e}", f"{errors[worst]:.1e}{where}"))
    columns = ("case", "Gaussians", "image error", "worst gradient error")
    note = (
        "The cpu engine in float32 against the reference in float64: largest difference of a color; of a "
        "gradient over the largest, of the input named. The cases are those of "
        "`tests/progdf/rasterize/test_rasterize.py`, which fails beyond its tolerances."
    )
    return [Table("hard", f"{len(rows)} hard cases", columns, tuple(rows), note)]


def _spread(times: list[float]) -> str:
    return f"{statistics.median(times):.1f} ({min(times):.1f}-{max(times):.1f})"
