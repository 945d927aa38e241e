"""Faults of devices by wire, and long runs with them: the world is another process, and its record says what moved and burned."""
