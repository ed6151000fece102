"""Coefficients of `probability.py`.

As `python -m experiments.study.refusal.fit_probability` fits them.

Of 6141 alignments, 4385 of them right, of seeds 0 to 4 of alias_copy, alias_copy_apart,
alias_light, alias_mirror, alias_posters, alias_posters_apart, alias_rooms, alias_rooms_apart,
corridor, opposite, rooms_low, rooms_high, posters, posters_apart.
"""

VERSION = 3
INTERCEPT = 0.068
WEIGHTS = (0.210, 0.663, 3.391, -2.409, 0.551, -1.927, -6.426)
