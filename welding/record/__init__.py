"""What a weld was: process, heat input and the weld log."""
