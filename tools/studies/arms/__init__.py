"""The demo on every arm of Universal Robots, its cell scaled to the arm's reach."""
