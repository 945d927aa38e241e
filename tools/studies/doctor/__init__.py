"""Causes that are injected into simulated sets of scans, and which of them the doctor names."""
