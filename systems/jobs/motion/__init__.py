"""Calibration of a streaming scanner while the arm moves."""
