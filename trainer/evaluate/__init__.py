"""What papers report of an edit: `progdf evaluate` measures a finished run."""
