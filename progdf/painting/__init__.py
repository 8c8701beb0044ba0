"""Painting on a scene: brush strokes in RGBA pictures, and their projection along the surface."""
