"""Hand-eye calibration in every mounting: F X G = Y H Z from poses, points, or points with normals."""
