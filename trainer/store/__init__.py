"""The run folder: its files and the saved state of a stopped run."""
