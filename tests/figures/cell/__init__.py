"""Studies of the whole simulated cell."""
