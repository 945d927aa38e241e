"""From observations of the flange to X_BC of a scanner beside the arm, its covariance and its validation."""
