"""The window and what happens in it."""
