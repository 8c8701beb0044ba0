"""The fast engine: numba kernels, tile based, with an analytic backward pass."""
