"""Live calibration of a scanner in any mounting."""
