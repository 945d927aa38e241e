"""Seam planning from one scan, over parts, scanners and disturbances."""
