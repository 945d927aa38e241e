"""Drivers of sensors by wire: files, video streams, GenICam and RealSense devices."""
