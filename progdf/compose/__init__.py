"""Composition of a scene with a stack of edits."""
