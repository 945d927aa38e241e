"""The tablet job: one picture of a tablet, then a touch of each landmark."""
