"""A touch as the judge of a calibration: points that the scanner measured, touched by the robot's tip."""
