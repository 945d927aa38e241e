"""Hand-eye calibration from pictures of a board."""
