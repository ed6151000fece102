"""Figures 1 to 10, drawn from a result's stored tables and key frames alone."""
