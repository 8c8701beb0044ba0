"""Pulls: drag points of a region, and the rest follows as rigidly as possible.

graph    nodes over the region's Gaussians, and edges between those that belong together
solve    positions and rotations of the nodes for given positions of the handles
follow   Gaussians move, rotate and stretch with the nodes near them
course   the whole path of a pull over strengths, which `progdf.tidy` stores as an edit
"""
