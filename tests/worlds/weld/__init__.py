"""Kinematic world of the weld law: true seam, groove, robot, tag, and the figures of a run."""
