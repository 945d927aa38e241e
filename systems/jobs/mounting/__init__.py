"""Calibration of a scanner in any mounting, live."""
