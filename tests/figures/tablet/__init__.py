"""The tablet paper's tables, computed again."""
