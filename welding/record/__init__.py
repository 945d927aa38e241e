"""Welding process, figures of a weld, and the weld log."""
