"""Refinements of a calibration by a field of residuals or by the kinematics of the arm."""
