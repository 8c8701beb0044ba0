"""Commands `progdf view`, `render` and `export`."""
