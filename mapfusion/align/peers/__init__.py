"""Adapters for aligners of other packages, one per module (extra `[peers]`)."""
