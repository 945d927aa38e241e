"""The touch job: the soft tip touches places that the scanner has measured, to judge a calibration."""
