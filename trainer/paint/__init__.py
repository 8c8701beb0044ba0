"""Paint that is finer than the Gaussians: surface discs and their colors."""
