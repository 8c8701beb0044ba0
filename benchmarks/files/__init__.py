"""Benchmarks of reading, checking and writing of files."""
