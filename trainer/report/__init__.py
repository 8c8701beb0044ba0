"""Quality report of a run: measurements and pictures."""
