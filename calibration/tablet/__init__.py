"""Calibrates a camera and a pen on the robot with a tablet as the target."""
