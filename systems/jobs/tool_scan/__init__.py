"""The tool scan: the arm shows its tool to the fixed scanner from all sides, to measure the torch."""
