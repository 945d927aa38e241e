"""Calibrates a laser profiler by planes, and by edge, sphere and planes of one mounting together."""
