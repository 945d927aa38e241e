"""Files that other programs write, as frames: what is new and complete, and how to ask for more."""
