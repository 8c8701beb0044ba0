"""Benchmarks of edits that move parts."""
