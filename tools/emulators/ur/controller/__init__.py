"""The emulated controller itself: power, safety, arm and registers."""
