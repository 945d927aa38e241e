"""The two-stage calibration of the tablet paper."""
