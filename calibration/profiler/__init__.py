"""Calibrates laser profilers on the flange by straight edges, spheres and touches."""
