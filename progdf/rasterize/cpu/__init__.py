"""Fast engine: tile-based numba kernels with an analytic backward pass."""
