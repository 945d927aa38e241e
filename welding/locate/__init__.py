"""Locates the workpiece and its groove in a scan."""
