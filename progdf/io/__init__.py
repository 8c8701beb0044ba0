"""File input and output: atomic writing, images, cameras, JSON, tensors, sessions and bundles."""
