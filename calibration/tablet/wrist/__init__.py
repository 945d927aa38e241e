"""Tablet calibration from full robot poses of the wrist."""
