"""Figures 1 to 12 and those of studies, drawn from stored tables and key frames alone."""
