"""The profiler papers' tables, computed again, and studies of the profiler calibration."""
