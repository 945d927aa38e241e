"""A Universal Robots controller on loopback: it runs the URScript it is sent and lies only where a test asks it to."""
