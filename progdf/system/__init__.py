"""Differences between systems and Python versions: processes, files, the desktop and equality."""
