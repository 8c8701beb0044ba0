"""All compiled kernels, run once on tiny inputs, in two parts that take about as long."""

from __future__ import annotations

import subprocess
import sys

from .paths import ROOT

_RASTERIZER_KERNELS = """
import torch
from progdf.rasterize import ActivatedGaussians, activate, render
from tests.helpers.scenes import ball, front_camera

scene, camera = ball(50), front_camera()
render(scene, camera)
for antialiased in (False, True):
    leaves = [tensor.clone().requires_grad_() for tensor in activate(scene).tensors]
    gaussians = ActivatedGaussians(*leaves, antialiased)
    render(gaussians, camera).image.sum().backward()
    render(gaussians, camera, grad_rows=torch.arange(5)).image.sum().backward()
"""

_OTHER_KERNELS = """
import numpy
import torch
from progdf.compose.composer import Composer
from progdf.compose.layers import Layer
from progdf.rasterize import activate, alpha_weights
from progdf.rasterize.engines import color_map
from progdf.rasterize.cpu.pyramid import Pyramid
from progdf.rasterize.cpu.rings import render_rings
from progdf.rasterize.screen import draw_lines_behind
from tests.helpers.edits import curved_field, edit_of, some_rows
from tests.helpers.scenes import ball, front_camera

scene, camera = ball(50), front_camera()
rows = some_rows(scene, 20)
gdf = edit_of(scene, rows, curved_field(20))
Composer(scene, [gdf]).update([Layer(gdf, 0.5)])
pyramid = Pyramid(activate(scene))
pyramid.simplify(camera, 10)
pyramid.refresh(rows.numpy(), True)
picture, left = torch.ones(camera.height, camera.width, 3), torch.ones(camera.height, camera.width)
lines = numpy.zeros((0, 14), numpy.float32)
with draw_lines_behind(picture.numpy(), left.numpy(), lines, 0.5):
    pass
weighed = color_map(activate(scene), camera, (0, 0, camera.width, camera.height), rows)
weighed.gradient(weighed.picture(torch.ones(20, 3)))
alpha_weights(scene, camera, left)
render_rings(activate(scene), camera, (1.0, 1.0, 1.0))
"""

PARTS = (_RASTERIZER_KERNELS, _OTHER_KERNELS)


def run_kernels(part: str) -> None:
    """Compile the missing kernels of a part in a separate process."""
    subprocess.run([sys.executable, "-c", part], check=True, cwd=ROOT)
