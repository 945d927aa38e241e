"""Plans poses: reach, clearance, visibility, observability and the next best pose."""
