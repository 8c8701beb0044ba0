"""Measures of a finished run as papers report them: `progdf evaluate`."""
