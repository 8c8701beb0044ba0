"""The whole job, from a scene to a .gdf and its report."""
