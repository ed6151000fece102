"""Coefficients of `probability.py`.

Written by `python -m experiments.study.refusal.fit_probability`.

Of 3193 alignments, 1952 of them right, of seeds 0 to 4 of alias, full, posters, posters_apart.
"""

VERSION = 1
INTERCEPT = -1.063
WEIGHTS = (0.750, 2.664, -1.102, 0.530, -1.318, -6.187)
