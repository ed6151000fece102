"""Simulator: textured worlds, P3-AT robots, stereo heads, and the truth about them."""
