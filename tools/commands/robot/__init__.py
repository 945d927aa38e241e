"""The commands that list, check and emulate robots."""
