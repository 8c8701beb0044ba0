"""Scenes in every format that people have."""
