"""Hand-eye solvers on recorded and random data."""
