"""Coefficients of `probability.py`.

Written by `python -m experiments.study.refusal.fit_probability`.

Of 3193 alignments, 1952 of them right, of seeds 0 to 4 of alias, full, posters, posters_apart.
"""

VERSION = 3
INTERCEPT = -0.240
WEIGHTS = (0.292, 0.958, 2.132, -2.105, 0.450, -2.060, -6.888)
