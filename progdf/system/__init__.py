"""Differences between Linux, Windows and macOS, in one place: processes, files and the desktop."""
