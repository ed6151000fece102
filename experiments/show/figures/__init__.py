"""Figures 1 to 10, drawn from a result's stored tables and key frames alone."""

from experiments.show.figures.drawing import draw_all

__all__ = ["draw_all"]
