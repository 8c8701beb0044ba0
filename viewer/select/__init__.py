"""Selecting in the picture with the mouse: gestures, what they select, and how they are drawn."""
