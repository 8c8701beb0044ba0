"""Scripts that make and check a release; not in the wheel."""
