"""Refusal study: maps with and without common ground, and the verdicts on them."""
