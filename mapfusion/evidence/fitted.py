"""Coefficients of `probability.py`.

Written by `python -m experiments.study.refusal.fit_probability`.

Of 3135 alignments, 1914 of them right, of seeds 0 to 4 of alias_copy, alias_copy_apart,
alias_light, alias_mirror, alias_posters, alias_posters_apart, alias_rooms, alias_rooms_apart, full,
posters, posters_apart.
"""

VERSION = 3
INTERCEPT = -2.394
WEIGHTS = (0.295, 0.667, 3.092, -1.685, 0.512, -1.617, -6.075)
