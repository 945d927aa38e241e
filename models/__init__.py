"""What exists: arms, flanges, scanners, the soft tool, workpieces, scenarios."""
