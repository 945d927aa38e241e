"""Simulated parts, rigs and recordings that tests and studies share."""
