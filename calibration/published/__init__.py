"""The methods of the flange paper: circle search, Algorithm 1 and its ICP figure."""
