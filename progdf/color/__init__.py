"""Color edits as pure functions."""
