"""Checks of a UR controller before the first motion, with the operator action for each failure."""
