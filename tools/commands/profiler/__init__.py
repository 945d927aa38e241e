"""The work behind `weldcal profiler`."""
