"""Evidence for and against an alignment, from what both robots looked at, and the verdict on it."""
