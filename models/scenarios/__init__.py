"""Named scenarios of the cell, as YAML."""
