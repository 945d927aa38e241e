"""Simulated devices and the world they act in."""
