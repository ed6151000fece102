"""Coefficients of `probability.py`.

As `python -m experiments.study.refusal.fit_probability` fits them.

Of 6175 alignments, 4390 of them right, of seeds 0 to 4 of alias, full, posters, posters_apart.
"""

VERSION = 3
INTERCEPT = -0.567
WEIGHTS = (0.225, 0.749, 2.908, -1.920, 0.506, -2.171, -6.543)
