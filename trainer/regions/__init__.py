"""Regions from masks, strokes, prompts and changed pictures."""
