"""The differentiable rasterizer: one signature, several engines.

`reference` is plain torch, slow, in any floating type: the oracle. `cpu` is numba, fast, with an analytic
backward. The conventions both follow are at the head of `engines.py`; beyond those numbers:

- the support of a Gaussian is exactly {alpha ≥ 1/255}, whatever the tile size;
- the near plane cuts at camera z > `near`; order is camera z in float32, ties by index;
- pixel centers lie at column + 0.5, row + 0.5;
- a Gaussian with a number that is not finite is not drawn; a quaternion that is zero or not finite is the
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
