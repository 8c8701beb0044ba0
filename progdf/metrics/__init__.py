"""Image errors, and statistics of a slider."""
