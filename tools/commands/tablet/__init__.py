"""The work behind `weldcal tablet`."""
