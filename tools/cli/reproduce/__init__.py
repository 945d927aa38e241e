"""The command lines of `weldcal reproduce`."""
