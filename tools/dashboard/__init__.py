"""Show a running cell on one page of this computer, with buttons to hold it, go on, or end it."""
