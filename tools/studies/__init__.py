"""Studies that reproduce published or targeted figures from one command."""
