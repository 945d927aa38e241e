"""Robot arms: kinematics, limits and masses."""
