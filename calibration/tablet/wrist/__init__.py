"""Calibrates camera and pen on the wrist from full robot poses."""
