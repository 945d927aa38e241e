"""The flange paper's methods by name: circle, segmentation, Algorithm 1 and its ICP figure."""
