"""From a scan to the circle of the robot's flange: search, fit, tracking and hole pattern."""
