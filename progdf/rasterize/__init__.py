"""Differentiable rasterizer: one signature, several engines.

`reference` is plain torch in any floating type. It is slow, and the tests compare against it. `cpu` is numba
and fast, with an analytic backward pass. `warp` runs on a CUDA device. The numbers that all engines share are
the constants of `engines.py`. Further conventions:

- The support of a Gaussian is exactly {alpha ≥ 1/255}, whatever the tile size.
- The near plane keeps camera z > `near`. The order is camera z in float32, ties by index.
- Pixel centers lie at column + 0.5, row + 0.5.
- A Gaussian with a non-finite number is not drawn. A zero or non-finite quaternion is replaced by the
  identity.
"""

from progdf.threads import set_threads

from .engines import ENGINES, ActivatedGaussians, Crop, RasterInfo, Rendering, activate, alpha_weights, render

__all__ = [
    "ENGINES",
    "ActivatedGaussians",
    "Crop",
    "RasterInfo",
    "Rendering",
    "activate",
    "alpha_weights",
    "render",
    "set_threads",
]
