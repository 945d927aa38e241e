"""The methods of the flange paper: segmentation, circle search, Algorithm 1 and its ICP figure."""
