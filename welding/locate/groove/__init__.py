"""Finds V-grooves in a point cloud and measures their root and shoulder lines."""
