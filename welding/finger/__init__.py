"""The finger: how far its soft tip is bent, from pictures of the tag behind it, and the calibration of its camera."""
