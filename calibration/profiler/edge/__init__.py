"""A laser profiler calibrated by a straight edge."""
