"""Results of weldcal that hold while its structure changes."""
