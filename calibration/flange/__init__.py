"""Finds, fits and tracks the robot's flange in a scan: its circle and its hole pattern."""
