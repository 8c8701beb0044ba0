"""Inspection of the picture: readouts at the pointer, the status line, and the cameras of the scene."""
