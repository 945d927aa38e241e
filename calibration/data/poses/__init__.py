"""Poses of a robot as people record them: notations, files, names, and the clouds that belong to them."""
