"""The simulator: textured worlds, P3-AT robots, a stereo head; it knows the truth."""
