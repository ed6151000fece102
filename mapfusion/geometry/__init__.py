"""Geometry and numerical building blocks that all other packages use."""
