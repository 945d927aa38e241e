"""Stitches, the passes after the root, and the beads that they lay."""
