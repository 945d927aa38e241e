"""A laser profiler calibrated by a sphere, with touches where there are any."""
