"""The main job: calibrate, verify, scan the workpiece, plan the seam, weld."""
