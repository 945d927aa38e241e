"""Tablet calibration from touches that move in the tablet's plane."""
