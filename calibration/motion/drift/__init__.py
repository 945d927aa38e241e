"""Monitor a calibration in motion: residuals, their noise, the sequential test, the possible causes."""
