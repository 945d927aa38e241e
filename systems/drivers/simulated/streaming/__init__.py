"""Scanners that stream, in simulation."""
