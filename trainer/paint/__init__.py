"""Paint that is finer than the Gaussians: discs on the surface, with the colors that show it."""
