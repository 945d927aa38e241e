"""Simulated parts, rigs, scans and recordings with a known truth, for tests and studies."""
