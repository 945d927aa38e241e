"""Calibrates a laser profiler by a sphere, with or without touches."""
