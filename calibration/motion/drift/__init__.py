"""Watching a calibration in motion: residuals, their noise, the sequential test, what can be told of the cause."""
