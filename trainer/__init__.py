"""Offline trainer: edit a region, record the trajectory, fit the field, write a .gdf file."""
