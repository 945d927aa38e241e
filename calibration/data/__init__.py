"""Reads and writes datasets, point clouds, tables and calibration results."""
