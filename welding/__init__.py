"""Locating, following and recording a weld seam, without Drake systems."""
