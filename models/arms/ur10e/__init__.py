"""The UR10e: Universal Robots' published numbers."""
