"""Emulated Universal Robots controller on loopback: runs URScript and injects faults that a test asks for."""
