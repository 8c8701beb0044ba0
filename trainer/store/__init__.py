"""The run folder: what lies where, and what a stopped run needs."""
