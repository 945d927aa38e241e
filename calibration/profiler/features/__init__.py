"""Features that a calibrated profiler measures: V-grooves and frustums."""
