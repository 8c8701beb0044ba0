"""Rendering of the state: engine, renderers, dynamic resolution, highlights, picking."""
