"""Studies of calibration in motion."""
