"""Benchmarks of speed and error, and ablations: `python -m benchmarks`."""
