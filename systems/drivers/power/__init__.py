"""Drivers of welding power sources."""
