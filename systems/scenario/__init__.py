"""The scenario file: its schema, its loader and its checks."""
