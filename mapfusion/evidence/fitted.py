"""Coefficients of `probability.py`.

Written by `python -m experiments.study.refusal.fit_probability`.

Of 3193 alignments, 1952 of them right, of seeds 0 to 4 of alias, full, posters, posters_apart.
"""

VERSION = 2
INTERCEPT = 0.133
WEIGHTS = (0.800, 2.256, -1.557, 0.555, -1.690, -6.285)
