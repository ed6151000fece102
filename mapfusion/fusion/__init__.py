"""Fusion of aligned maps: pose graph of the robots, one module per fuser, and the merge."""
