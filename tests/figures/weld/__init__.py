"""The weld law in a small kinematic world, against its targets."""
