"""Benchmarks of the robot link: timing and faults."""
