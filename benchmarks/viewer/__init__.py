"""Benchmarks of the viewer: sliders, frames and the idle window."""
