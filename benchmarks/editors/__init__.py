"""Benchmarks of editors."""
