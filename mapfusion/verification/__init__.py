"""Verification of an alignment: evidence for and against it, and the verdict."""
