"""Bodies added to a plant, simulated or for display only: the flange, the welding tool, printed boards."""
