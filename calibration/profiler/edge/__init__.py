"""Calibrates a laser profiler by a straight edge."""
