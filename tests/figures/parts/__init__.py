"""Study of registering parts from files in scans with clutter, and of measuring their joints."""
