"""Parts to be welded: grooved plates, parts read from files, their edges, seams and joints."""
