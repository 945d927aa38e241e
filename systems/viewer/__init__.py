"""Display of the cell's estimates in Meshcat."""
