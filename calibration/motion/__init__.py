"""Calibration and tracking while the arm moves: the robot's motion in continuous time, clocks, drift."""
