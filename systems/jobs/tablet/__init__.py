"""A visit to a tablet: one look, then a touch of each landmark."""
