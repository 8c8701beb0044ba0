"""Smooth surfaces fitted to the depth that a camera sees."""
