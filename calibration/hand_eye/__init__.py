"""Hand-eye calibration in every mounting: one equation F X G = Y H Z, solved from poses, points or points with normals."""
