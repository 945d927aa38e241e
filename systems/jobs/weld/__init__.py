"""The weld job: calibrate, verify, scan the workpiece, plan the seam, weld."""
