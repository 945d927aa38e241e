"""Calibration of a laser profiler by an edge or a sphere, live, and a seam measured with it."""
