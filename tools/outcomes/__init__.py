"""Results of runs, as commands return them and reports show them, with errors against the ground truth of a simulation."""
