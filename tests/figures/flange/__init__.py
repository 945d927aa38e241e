"""Studies of the flange calibration: speed, coverage, limits."""
