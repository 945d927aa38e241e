"""The command lines of `weldcal benchmark`."""
