"""Adapters for other people's aligners, one per module (extra `[peers]`)."""
