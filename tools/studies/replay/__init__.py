"""Study of replay: runs of every kind are recorded, and replayed bit for bit."""
