"""Coefficients of `probability.py`.

As `python -m experiments.studies.verdict_fitting probability` fits them.

Of 6154 alignments, 4392 of them right, of seeds 0 to 4 of alias_copy, alias_copy_apart,
alias_light, alias_mirror, alias_posters, alias_posters_apart, alias_rooms, alias_rooms_apart,
corridor, opposite, rooms_low, rooms_high, posters, posters_apart.
"""

VERSION = 3
INTERCEPT = -0.252
WEIGHTS = (0.200, 0.848, 2.612, -1.971, 0.501, -2.203, -6.835)
