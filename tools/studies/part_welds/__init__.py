"""Welds of twelve parts in four joints: STEP files made by OpenCascade, planned and welded in the simulated cell."""
