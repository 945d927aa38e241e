"""Estimates X_BC of a scanner beside the arm from observations of the flange, with covariance and validation."""
