"""Where the part and its groove lie in a scan."""
