"""`progdf view`, `render` and `export`."""
