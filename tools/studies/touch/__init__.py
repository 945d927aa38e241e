"""Studies of touches as the judge of a calibration."""
