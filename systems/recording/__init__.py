"""Recordings of runs: what entered and left the station, in one MCAP file, and the station that plays it back."""
