"""One folder a job: its systems, and the function that adds them to a cell."""
