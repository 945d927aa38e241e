"""Calibration while the arm moves: continuous poses, clocks, tracking and drift."""
