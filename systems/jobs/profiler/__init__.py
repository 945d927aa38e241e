"""Live calibration of a laser profiler by an edge or a sphere, and measurement of a seam with it."""
