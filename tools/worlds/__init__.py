"""Simulated parts, cells and robots that tests and studies share."""
