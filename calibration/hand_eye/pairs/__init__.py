"""Pairs of poses: read, decided by the data, judged."""
