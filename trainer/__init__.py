"""The offline trainer: edits a region, records the trajectory, fits the field, writes a .gdf file."""
