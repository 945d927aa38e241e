"""The tablet paper's two-stage calibration by name."""
