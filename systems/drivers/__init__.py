"""One file per backend: the only code that knows what is real and what is simulated."""
