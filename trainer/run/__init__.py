"""Training runs, from a scene to a .gdf file and its report."""
