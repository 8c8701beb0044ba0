"""The .gdf file: one edit, bound to its scene."""
