"""Constant of `likelihood.py`: share of repeated regions that repeat throughout.

Written by `python -m experiments.studies.verdict_fitting twins`.

Of 2247 regions under wrong motions of seeds 0 to 4 of
posters_apart, alias_posters_apart: 4.7% are twins throughout, 6.5% in part.
"""

WHOLE = 0.42
