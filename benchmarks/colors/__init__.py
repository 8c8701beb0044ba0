"""Benchmarks of color edits."""
