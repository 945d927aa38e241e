"""What the cell believes, drawn in Meshcat."""
