"""Coefficients of `probability.py`.

Written by `python -m experiments.study.refusal.fit_probability`.

Of 1887 alignments, 1139 of them right, of seeds 0 to 2 of alias, full, posters, posters_apart.
"""

VERSION = 1
INTERCEPT = -3.037
WEIGHTS = (0.585, 3.717, 0.849, 0.588, -1.090, -5.173)
