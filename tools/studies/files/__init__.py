"""Damaged files for every reader: valid examples, their mutations, and what a reader does with them."""
