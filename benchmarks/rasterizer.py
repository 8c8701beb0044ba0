"""The benchmarks `rasterize`, `warp` and `hard`: speed and error of the rasterizers.

The cpu engine is compared with a plain tiled renderer in torch, float32, differentiated by autograd. Its
tiles have 16x16 pixels, and every Gaussian listed for a tile is evaluated at every pixel. A tile lists the
Gaussians whose square of three standard deviations of the longer axis touches it, as published (Kerbl 2023).
The two renderers take turns in one process, on one thread each and on two.

The warp engine is measured on a CUDA GPU if there is one, otherwise on the CPU, for its errors only.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from math import pi

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics
from progdf.gaussians import Gaussians, pack
from progdf.rasterize import reference, render, set_threads
from progdf.rasterize.cpu.weights import ListedWeights
from progdf.rasterize.engines import ActivatedGaussians, RasterView, color_map, engine_device
from progdf.sh import C0
from progdf.terminal import group_digits
from trainer.optimize.color_views import OMITTED_WEIGHT
from trainer.optimize.losses import Objective, perceptual_loss
from trainer.optimize.pgs import PgsSettings, TargetStage, learning_rates, optimize
from trainer.options import OptimizeOptions
from trainer.views.crops import crop_scene

from .table import Table, Wall

INPUTS = ("means", "quats", "scales", "opacities", "colors")


@dataclass(frozen=True)
class RasterCase:
    """A random cloud in front of a camera."""

    count: int  # Gaussians
    size: int  # width of the image, pixels
    baseline: bool = True  # False if torch needs more memory than a small machine has
    height: int = 0  # height of the image, pixels; 0: equal to its width


CASES = (RasterCase(2_000, 128), RasterCase(20_000, 256), RasterCase(100_000, 512, baseline=False))
WARP_CASES = CASES[:2]
CARD_CASES = (RasterCase(200_000, 512, False), RasterCase(1_000_000, 1920, False, 1080))
STEP_CASE = RasterCase(200_000, 512, False)


THREADS = (1, 2)


@dataclass(frozen=True)
class Duel:
    """Times of the cpu engine and of torch by round, ms."""

    threads: int  # number of threads
    forward: list[float]  # cpu engine, forward
    both: list[float]  # cpu engine, forward and backward
    processor: list[float]  # the same, processor time of all cores
    ours: list[float]  # median of `both` per round of torch; empty if torch is not run
    torch: list[float]  # torch, forward and backward

    @property
    def ratio(self) -> float:
        """Speedup over torch: the median over the rounds of each round's ratio."""
        return statistics.median(b / a for a, b in zip(self.ours, self.torch, strict=True))


@dataclass(frozen=True)
class RasterTimes:
    """Times of one case, and errors against float64."""

    case: RasterCase
    duels: list[Duel]  # one for each of `THREADS`, with the tiled torch renderer if it is run
    plain: float  # processor time of the plain version in float64, ms
    image_error: float  # largest difference of a color
    gradient_errors: dict[str, float]  # largest difference over the largest gradient, by input


def cloud(case: RasterCase) -> tuple[ActivatedGaussians, Camera]:
    """Make a seeded cloud of activated Gaussians and a camera that sees most of them.

    A Gaussian's standard deviation is about 1.4 pixels and its axes differ by a factor of about 2, as in a
    trained scene seen from its training cameras.
    """
    rng = torch.Generator().manual_seed(case.count)
    means = torch.randn(case.count, 3, generator=rng) * 0.7 + torch.tensor([0.0, 0.0, 4.0])
    height = case.height or case.size
    K = intrinsics(0.9, case.size, height)
    scale = 1.4 * 4.0 / float(K[0, 0])
    scales = scale * torch.exp(0.5 * torch.randn(case.count, 3, generator=rng))
    quats = torch.randn(case.count, 4, generator=rng)
    opacities = torch.sigmoid(1.5 * torch.randn(case.count, generator=rng))
    colors = torch.rand(case.count, 3, generator=rng)
    activated = ActivatedGaussians(means, quats, scales, opacities, colors)
    return activated, Camera(torch.eye(4), K, case.size, height)


def draw(
    inputs: ActivatedGaussians, camera: Camera, engine: str, dtype: torch.dtype, backward: bool
) -> tuple[float, Tensor, list[Tensor]]:
    """Run one pass; return its milliseconds, the image, and the gradients for a fixed image gradient."""
    leaves = inputs.each(lambda tensor: tensor.clone().to(dtype).requires_grad_(backward))
    across, down = (
        torch.linspace(0.0, pi, side, dtype=dtype, device=leaves.means.device).sin()
        for side in (camera.width, camera.height)
    )
    grad_image = torch.stack([down[:, None] * across, down[:, None] - across, -across * down[:, None]], -1)
    _settle(leaves.means)
    begin = time.perf_counter()
    image = _image(engine, leaves, camera)
    if backward:
        image.backward(grad_image)  # type: ignore[no-untyped-call]
    _settle(leaves.means)
    elapsed = 1e3 * (time.perf_counter() - begin)
    return elapsed, image.detach(), [leaf.grad for leaf in leaves.tensors if leaf.grad is not None]


def _settle(tensor: Tensor) -> None:
    """Wait for the queued work of a CUDA GPU."""
    if tensor.is_cuda:
        torch.cuda.synchronize()


def _image(engine: str, gaussians: ActivatedGaussians, camera: Camera) -> Tensor:
    black = gaussians.means.new_zeros(3)
    if engine != "tiled":
        return render(gaussians, camera, black, engine=engine).image
    view = RasterView.of(camera, gaussians)
    splats, _ = reference.project(gaussians, view)
    image, _ = reference.blend(three_sigma(splats), view.crop, black)
    return image


def three_sigma(splats: reference.ReferenceSplats) -> reference.ReferenceSplats:
    """Return the splats with the published extents: a square of three standard deviations of the longer axis.

    The extents are whole pixels. They cut off the part of a Gaussian between there and alpha = 1/255.
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
        case: the cloud and the image size
        rounds: rounds of the cpu engine within each round of torch
        torch_rounds: rounds of torch
    """
    inputs, camera = cloud(case)
    _, image, gradients = draw(inputs, camera, "cpu", torch.float32, backward=True)
    duels = []
    for threads in THREADS:
        duel = Duel(threads, [], [], [], [], [])
        duels.append(duel)
        if case.baseline:
            with _threads(threads):
                draw(inputs, camera, "tiled", torch.float32, backward=True)
        for _ in range(torch_rounds):
            # the kernels have their own threads; torch's would only busy-wait
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
    return RasterTimes(case, duels, plain, *_errors(image, gradients, exact, exact_gradients))


def _errors(
    image: Tensor, gradients: list[Tensor], exact: Tensor, exact_gradients: list[Tensor]
) -> tuple[float, dict[str, float]]:
    """Return the largest color difference, and each input's largest gradient difference over its maximum."""
    errors = {
        name: float((gradient.cpu() - expected).abs().max() / expected.abs().max())
        for name, gradient, expected in zip(INPUTS, gradients, exact_gradients, strict=False)
    }
    return float((image.cpu() - exact).abs().max()), errors


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
    """Measure the cpu engine and make its tables."""
    results = [measure(case) for case in CASES]
    rows = []
    for result in results:
        case = result.case
        worst = max(result.gradient_errors, key=lambda name: result.gradient_errors[name], default="")
        baseline = "not run" if not case.baseline else ""
        rows += [
            {
                "Gaussians": group_digits(case.count),
                "pixels": f"{case.size}²",
                "threads": str(duel.threads),
                Wall("forward (ms)"): _spread(duel.forward),
                Wall("forward + backward (ms)"): _spread(duel.both),
                "processor time (ms)": f"{statistics.median(duel.processor):.1f}",
                Wall("tiled torch (ms)"): baseline or _spread(duel.torch),
                "ratio": baseline or f"{duel.ratio:.0f}×",
                "plain version, processor time (ms)": f"{result.plain:.0f}",
                "image error": f"{result.image_error:.1e}",
                "worst gradient error": f"{result.gradient_errors[worst]:.1e} ({worst})"
                if worst
                else "not run",
            }
            for duel in result.duels
        ]

    note = (
        "Median and range; the engines take turns in one process. The plain version is "
        "`progdf.rasterize.reference` in float64, forward only if no gradient error is given. Errors are "
        "against it: largest difference of a color, and of a gradient over its maximum, with the worst input "
        "named. Dense tiles in torch are a weak baseline. OpenSplat's CPU engine, in one run with an earlier "
        "engine of ours, took 4.5 to 8.9 times as long as ours, "
        "and its gradients of quats and scales were wrong."
    )
    return [Table.of("rasterize", "CPU rasterizer", rows, note), list_table(CASES)]


def list_table(cases: Sequence[RasterCase], rounds: int = 9) -> Table:
    """Measure views as weight lists, which color edits are solved with, with and without negligible weights.

    Args:
        cases: clouds and image sizes; every Gaussian has a weight list
        rounds: measured rounds, whose median is reported; both variants take turns
    """
    rows = []
    for case in cases:
        inputs, camera = cloud(case)
        window = (0, 0, camera.width, camera.height)
        every = torch.arange(case.count)
        times: dict[float, list[tuple[float, float]]] = {0.0: [], OMITTED_WEIGHT: []}
        pictures = dict[float, Tensor]()
        entries = dict[float, int]()
        with _threads(1, 1):
            for _ in range(rounds + 1):
                for lost, durations in times.items():
                    begin = time.process_time()
                    weights = color_map(inputs, camera, window, every, lost=lost)
                    listed = time.process_time()
                    pictures[lost] = weights.picture(inputs.colors)
                    weights.gradient(pictures[lost])
                    durations.append((1e3 * (listed - begin), 1e3 * (time.process_time() - listed)))
                    assert isinstance(weights, ListedWeights)
                    entries[lost] = len(weights.entries()[2])
        listing, rendering = (
            [f"{statistics.median(pair[k] for pair in durations[1:]):.1f}" for durations in times.values()]
            for k in (0, 1)
        )
        difference = float((pictures[OMITTED_WEIGHT] - pictures[0.0]).abs().max())
        left_out = f"{1.0 - entries[OMITTED_WEIGHT] / entries[0.0]:.0%}"
        size = group_digits(case.count), f"{case.size}²"
        rows.append((*size, left_out, *listing, *rendering, f"{difference:.4f}", f"{OMITTED_WEIGHT:.4f}"))
    columns = (
        "Gaussians",
        "pixels",
        "weights left out",
        "listed, processor time (ms)",
        "listed without these (ms)",
        "picture and gradient, processor time (ms)",
        "picture and gradient without these (ms)",
        "largest difference",
        "its bound",
    )
    note = (
        "A view as a function of colors, for color edits. The solver leaves out weights that together change "
        "a pixel by less than half of one of 255 levels; the run is evaluated with whole pictures. "
        "Trained scenes: docs/lab/experiments.md, Weights that hardly show."
    )
    return Table("lists", "A view as lists of weights", columns, tuple(rows), note)


def warp_tables(cases: Sequence[RasterCase] | None = None, rounds: int = 5) -> list[Table]:
    """Measure the warp engine on this machine's GPU, or on the CPU, where only its errors are meaningful.

    Args:
        cases: clouds and image sizes; None: `CARD_CASES` with a GPU, else `WARP_CASES`
        rounds: measured rounds, after one that is not counted; the median is reported
    """
    device = engine_device("warp")
    card = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU device, for tests"
    rows = []
    for case in cases or (CARD_CASES if device.type == "cuda" else WARP_CASES):
        inputs, camera = cloud(case)
        on_device = inputs.each(lambda tensor: tensor.to(device))
        oracle, dtype = ("reference", torch.float64) if case.baseline else ("cpu", torch.float32)
        _, exact, exact_gradients = draw(inputs, camera, oracle, dtype, backward=True)
        times = [
            [draw(on_device, camera, "warp", torch.float32, backward)[0] for _ in range(rounds + 1)][1:]
            for backward in (False, True)
        ]
        figures = []
        for engine, gaussians in (("warp", on_device), ("cpu", inputs)):
            used = []
            with _threads(1, 1):
                for _ in range(rounds + 1):
                    used.append(-time.process_time())
                    _, image, gradients = draw(gaussians, camera, engine, torch.float32, backward=True)
                    used[-1] += time.process_time()
            figures.append(f"{1e3 * statistics.median(used[1:]):.0f}")
            error, errors = _errors(image, gradients, exact, exact_gradients)
            worst = max(errors, key=lambda name: errors[name])
            figures += (
                [f"{error:.1e}", f"{errors[worst]:.1e} ({worst})"]
                if case.baseline or engine == "warp"
                else ["", ""]
            )
        count = group_digits(case.count)
        size = f"{camera.width}×{camera.height}"
        rows.append((card, count, size, *(_spread(some) for some in times), *figures))
    if device.type == "cuda":
        rows.append(
            (card, "200 000 members", "512×512", "–", f"{_step_time(STEP_CASE, 40):.1f} a step", *[""] * 6)
        )
    columns = (
        "device",
        "Gaussians",
        "pixels",
        Wall("forward (ms)"),
        Wall("forward + backward (ms)"),
        "processor time (ms)",
        "image error",
        "worst gradient error",
        "cpu engine, processor time (ms)",
        "its image error",
        "its worst gradient error",
    )
    note = (
        "Median and range, after the GPU has finished. Processor time: forward and backward, on one thread. "
        "Errors are against the reference in float64, and on a GPU (200 000 and 1 000 000 Gaussians) "
        "against the cpu engine. A step is a whole training step: rendering, L1, LPIPS every second step, "
        "gradients, Adam. Warp's CPU device runs the same kernels one thread after another, for tests only."
    )
    return [Table("warp", "The engine warp", columns, tuple(rows), note)]


def _step_time(case: RasterCase, steps: int) -> float:
    """Measure the milliseconds per step of `optimize` in the second half of the steps, all rows members."""
    inputs, camera = cloud(case)
    rgb = (inputs.colors - 0.5) / C0
    raw = Gaussians(
        inputs.means,
        inputs.quats,
        inputs.scales.log(),
        inputs.opacities.logit(),
        rgb,
        rgb[:, None].expand(-1, 0, 3),
    ).to(engine_device("warp"))
    crop = crop_scene(
        raw, torch.arange(case.count), camera, (0, 0, case.size, case.size), torch.ones(3), engine="warp"
    )
    rows = pack(raw, with_shN=False)
    target = crop.original.clamp(0.0, 1.0).flip(2)
    options = OptimizeOptions(perceptual_weight=0.3)
    settings = PgsSettings(learning_rates("style", rows.shape[1], 1.0), ramp=0.0, reach=0.0)
    ends: list[float] = []
    stages = [TargetStage(1.0, [target], steps)]
    objective = Objective(perceptual_loss()[0], options)
    for _ in optimize(
        rows, [crop], [], stages, objective, settings,
        on_step=lambda step, left: ends.append(time.perf_counter()),
    ):  # fmt: skip
        pass
    return 1e3 * (ends[-1] - ends[steps // 2]) / (steps - 1 - steps // 2)


def hard_tables() -> list[Table]:
    """Draw every hard case and report the largest differences of the fast engines from the reference."""
    from tests.helpers.camera_tables import REFUSED_VIEWMATS
    from tests.helpers.drawn import CASES as HARD
    from tests.helpers.drawn import drawn_case, image_error, relative_errors
    from tests.helpers.scenes import front_camera

    rows = []
    engines = ("cpu", "warp") if find_spec("warp") else ("cpu",)
    for name, case in HARD.items():
        plain = drawn_case(name, "reference")
        row = [name, group_digits(len(case.gaussians))]
        for engine in engines:
            fast = drawn_case(name, engine)
            errors = relative_errors(fast, plain)
            worst = max(errors, key=lambda name: errors[name])
            suffix = f" ({worst})" if errors[worst] else ""
            row += [f"{image_error(fast, plain):.1e}", f"{errors[worst]:.1e}{suffix}"]
        rows.append(tuple(row))
    for name, (change, _) in REFUSED_VIEWMATS.items():
        outcome = _camera_outcome(front_camera(), change)
        rows.append((f"viewmat {name}", "–", outcome, *["–"] * (2 * len(engines) - 1)))
    figures = [
        f"{engine}: {figure}" for engine in engines for figure in ("image error", "worst gradient error")
    ]
    columns = ("case", "Gaussians", *figures)
    note = (
        "The engines in float32 against the reference in float64, warp on its CPU device: largest "
        "difference of a color, over the brightest color if that is above 1, and of a gradient over its "
        "maximum, with the input named. The cases are those of `tests/progdf/rasterize/test_rasterize.py`, "
        "which checks its tolerances. A camera whose viewmat is not a rotation and translation is "
        "refused at construction, as engines rely on it."
    )
    return [Table("hard", f"{len(rows)} hard cases", columns, tuple(rows), note)]


def _camera_outcome(camera: Camera, change: Tensor) -> str:
    """Return the outcome for a camera with a changed viewmat: drawn, or refused with the reason."""
    try:
        replace(camera, viewmat=change @ camera.viewmat)
    except ValueError as error:
        return f"refused: {str(error).partition(';')[0]}"
    return "drawn"


def _spread(times: list[float]) -> str:
    return f"{statistics.median(times):.1f} ({min(times):.1f}-{max(times):.1f})"
