"""The planned seam: its curve, its feasibility and its refinement by touch."""
