"""The commands that bring a cell of one's own to its first job: its scenario, part, tool, board and devices."""
