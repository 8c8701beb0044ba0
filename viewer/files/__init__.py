"""Files that the viewer reads and writes."""
