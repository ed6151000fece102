"""Recordings of others as robot logs: one importer a file, each named once in `registry.py`."""
