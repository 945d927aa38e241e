"""Calibration in motion: a simulated world, the paper's experiments, accuracy and speed."""
