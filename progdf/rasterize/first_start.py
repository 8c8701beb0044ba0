"""First start on a machine: the kernels of the rasterizer are compiled at once, and counted.

Each kernel compiles at its first call, which takes seconds. A small scene calls them one after another before
the work begins, so that the wait has a known end. Later starts find them on the disk.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize.cpu.compilation import count_kernels, is_compiled, mark_compiled

from .cpu import engine
from .engines import ActivatedGaussians, RasterView, activate, alpha_weights, color_map, render

Report = Callable[[int, int], None]
"""Callback with the number of kernels that are ready and the number of all."""

KERNELS = {"draw": 5, "solve": 12, "descend": 14}
"""Number of kernels that each purpose takes: pictures; also the color solver; also steps by gradients."""

_LABEL = "compiling kernels"


def needs_kernels(purpose: str) -> bool:
    """Return True if the kernels of one of `KERNELS` have not been compiled on this machine."""
    return not is_compiled(f"rasterizer-{purpose}")


def compile_rasterizer(purpose: str, report: Report) -> None:
    """Compile the kernels of one of `KERNELS`, or load them from the disk.

    Args:
        purpose: key of `KERNELS`
        report: receives 0 at first, then a number after each kernel
    """
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    quats = torch.eye(4)[:1].expand(8, 4).contiguous()
    scene = Gaussians(
        means=corners,
        quats=quats,
        log_scales=corners - 2.0,
        logit_opacities=corners[:, 0].contiguous(),
        sh0=corners,
        shN=corners[:, None, :][:, :0],
    )
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    K = torch.tensor([[20.0, 0.0, 16.0], [0.0, 20.0, 16.0], [0.0, 0.0, 1.0]])
    camera = Camera(viewmat, K, 32, 32)
    with count_kernels(KERNELS[purpose], report):
        render(scene, camera)
        if purpose != "draw":
            rows = torch.arange(4)
            weighed = color_map(activate(scene), camera, (0, 0, 32, 32), rows)
            weighed.gradient(weighed.picture(torch.ones(4, 3)))
            weighed.picture(torch.ones(4, 1))
            alpha_weights(scene, camera, torch.ones(32, 32))
            black = torch.zeros(3)
            engine.rasterize_part(activate(scene), RasterView.of(camera, activate(scene), None), black, rows)
        if purpose == "descend":
            means, quats, scales, opacities, colors = (
                tensor.clone().requires_grad_() for tensor in activate(scene).tensors
            )
            leaves = ActivatedGaussians(means, quats, scales, opacities, colors)
            image = render(leaves, camera, grad_rows=torch.arange(4)).image
            torch.autograd.backward([image.sum()])
    mark_compiled(f"rasterizer-{purpose}")


def compile_with_bar(purpose: str) -> None:
    """Compile the kernels of one of `KERNELS` with a bar on a terminal, unless a start before has done it."""
    if needs_kernels(purpose):
        with kernel_bar() as report:
            compile_rasterizer(purpose, report)


@contextmanager
def kernel_bar() -> Iterator[Report]:
    """Yield a callback that moves a bar on a terminal, and does nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(_LABEL, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)
