"""The dashboard: one page on this computer that shows a running cell, with buttons to hold it, let it go on, or end
it."""
