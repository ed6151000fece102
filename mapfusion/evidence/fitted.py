"""Coefficients of `probability.py`.

Written by `python -m experiments.study.refusal.fit_probability`.

Of 3071 alignments, 1935 of them right, of seeds 0 to 9 of alias, full, posters and posters_apart.
"""

VERSION = 1
INTERCEPT = -1.341
WEIGHTS = (0.629, 2.968, 0.453, 0.43, -2.225, -6.661)
