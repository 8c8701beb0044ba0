"""What the viewer reads and writes."""
