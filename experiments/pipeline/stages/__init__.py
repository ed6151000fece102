"""Stages from the simulated world to the aligners' estimates, one per module."""
