"""Features measured by a calibrated profiler: V-grooves and frustums."""
