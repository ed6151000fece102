"""Fusers: how aligned maps become one. One file each, found by name (`registry.py`)."""
