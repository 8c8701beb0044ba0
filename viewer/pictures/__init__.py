"""Composed pictures: comparisons, contact sheets, films."""
