"""Captures by hand: each scan or picture is judged at once, and all lie in a folder that calibrates."""
