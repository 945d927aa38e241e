"""What each command does, and the dataclass that it returns."""
