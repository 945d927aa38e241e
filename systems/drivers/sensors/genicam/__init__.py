"""Drivers of GenICam devices through harvesters: scanners, finger cameras and laser profilers."""
