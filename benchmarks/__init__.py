"""Timings beside errors, and ablations: `python -m benchmarks`."""
