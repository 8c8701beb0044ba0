"""Everything that is compiled, run once on next to nothing."""

from __future__ import annotations

import subprocess
import sys

from .paths import ROOT

_CODE = """
import numpy
import torch
from progdf.compose.composer import Composer
from progdf.compose.layers import Layer
from progdf.rasterize import ActivatedGaussians, activate, alpha_weights, render
from progdf.rasterize.engines import color_map
from progdf.rasterize.cpu.pyramid import Pyramid
from progdf.rasterize.screen import lines_behind
from tests.helpers.edits import curved_field, edit_of, some_rows
from tests.helpers.scenes import ball, front_camera

scene, camera = ball(50), front_camera()
render(scene, camera)
for antialiased in (False, True):
    leaves = [tensor.clone().requires_grad_() for tensor in activate(scene).tensors]
    gaussians = ActivatedGaussians(*leaves, antialiased)
    render(gaussians, camera).image.sum().backward()
    render(gaussians, camera, grad_rows=torch.arange(5)).image.sum().backward()
alpha_weights(scene, camera, torch.ones(camera.height, camera.width))
picture = render(scene, camera)
lines = numpy.zeros((0, 14), numpy.float32)
with lines_behind(picture.image.numpy(), picture.transmittance.numpy(), lines, 0.5):
    pass
rows = some_rows(scene, 20)
pyramid = Pyramid(activate(scene))
pyramid.simplify(camera, 10)
pyramid.refresh(rows.numpy(), True)
weighed = color_map(activate(scene), camera, (0, 0, camera.width, camera.height), rows)
weighed.gradient(weighed.picture(torch.ones(20, 3)))
gdf = edit_of(scene, rows, curved_field(20))
Composer(scene, [gdf]).update([Layer(gdf, 0.5)])
"""


def run_all_kernels() -> None:
    """Compile what is not in the cache, in a process of its own."""
    subprocess.run([sys.executable, "-c", _CODE], check=True, cwd=ROOT)
