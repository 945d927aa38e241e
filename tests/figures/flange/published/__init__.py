"""The flange paper's tables and figures, computed again."""
