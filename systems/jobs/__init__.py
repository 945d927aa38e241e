"""Jobs, one folder each: the job's systems, and the class that adds them to a cell."""
