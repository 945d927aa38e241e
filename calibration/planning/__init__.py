"""Which poses to visit: reach, clearance, sight, observability and the next best pose."""
