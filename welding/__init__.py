"""The mathematics of following a seam: registration, deformation, refinement, servo law, guards."""
