"""Reader and writer of .gdf files: one edit each, bound to its scene."""
