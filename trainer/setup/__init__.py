"""What training works on: cameras, their number and size, the originals."""
