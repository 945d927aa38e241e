"""Bodies that a plant may hold, simulated or only drawn: the flange, the welding tool, printed boards."""
