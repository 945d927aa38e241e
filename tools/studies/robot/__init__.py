"""The robot link measured: timing and faults."""
