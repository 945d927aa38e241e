"""Laser profilers: a scanner of one plane, calibrated on the flange by straight edges, by spheres and by touches."""
