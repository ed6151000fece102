"""Figures 1 to 12, drawn from a result's stored tables and key frames alone."""
