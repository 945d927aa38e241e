"""Test bench of the robot link and of a cell by wire: faults, and what must follow."""
