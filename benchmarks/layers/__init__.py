"""Benchmarks of stacks of layers."""
