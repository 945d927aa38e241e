"""Tracks a link of the arm in scans taken in motion, by a model of its surface."""
