"""Robot arms as numbers: kinematics, limits and masses."""
