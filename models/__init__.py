"""Numbers and shapes of arms, flanges, scanners, profilers, the welding tool, workpieces and scenarios."""
